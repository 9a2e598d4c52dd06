// Sparklines: small curves of a register's last minute in the rows of the table. A failed read is a gap.

const SECONDS = 60;
const LEAST_SPAN = 1; // least range of values, so that noise of a standing motor does not look like a run

// Draw the samples of the minute before `until` (ms) into a canvas.
export function spark(canvas, ring, until, colour) {
  const width = canvas.clientWidth,
    height = canvas.clientHeight,
    ratio = devicePixelRatio;
  if (!width) return;
  if (canvas.width !== Math.round(width * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const from = until - SECONDS * 1000;
  const [times, values] = ring ? ring.since(from) : [[], []];
  const [low, high] = span(values);
  if (low === null) return;
  pen.strokeStyle = colour;
  pen.lineWidth = 1.2;
  pen.beginPath();
  let isDown = false;
  values.forEach((value, i) => {
    if (value === null) {
      isDown = false;
      return;
    }
    const x = 1 + ((times[i] - from) / (SECONDS * 1000)) * (width - 2);
    const y = height - 2 - ((value - low) / (high - low)) * (height - 4);
    if (isDown) pen.lineTo(x, y);
    else pen.moveTo(x, y);
    isDown = true;
  });
  pen.stroke();
}

function span(values) {
  let low = Infinity,
    high = -Infinity;
  for (const value of values) {
    if (value === null) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (low > high) return [null, null];
  const margin = Math.max(LEAST_SPAN - (high - low), 0) / 2;
  return [low - margin, high + margin];
}
