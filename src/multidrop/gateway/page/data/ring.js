// The newest samples of one register in a ring buffer: times in ms, and values with NaN for a failed read.

const FIRST = 64;

export class Ring {
  constructor(most) {
    this.most = most;
    this.count = 0;
    this.at = 0;
    this.times = new Float64Array(Math.min(FIRST, most));
    this.values = new Float64Array(this.times.length);
  }

  // Add a sample, unless it is already the newest one.
  add(ms, value) {
    if (this.count && this.times[(this.at + this.times.length - 1) % this.times.length] === ms) return;
    if (this.count === this.times.length && this.count < this.most) this.grow();
    this.times[this.at] = ms;
    this.values[this.at] = value;
    this.at = (this.at + 1) % this.times.length;
    this.count = Math.min(this.count + 1, this.times.length);
  }

  grow() {
    const [times, values] = this.since(-Infinity);
    const size = Math.min(this.most, this.count * 2);
    this.times = new Float64Array(size);
    this.values = new Float64Array(size);
    this.times.set(times);
    this.values.set(values.map(v => v ?? NaN));
    this.at = this.count % size;
  }

  // Return the times in ms and the values of the samples since `from`, oldest first; null is a failed read.
  since(from) {
    const times = [],
      values = [],
      size = this.times.length;
    for (let i = 0; i < this.count; i++) {
      const k = (this.at - this.count + i + size) % size;
      if (this.times[k] < from) continue;
      times.push(this.times[k]);
      values.push(Number.isNaN(this.values[k]) ? null : this.values[k]);
    }
    return [times, values];
  }
}
