// The plant's description and newest values, as the gateway sends them, and recent samples of each register
// for plots. Each value has its time, so that the page can mark old values.

import { t } from "../texts.js";
import { Ring } from "./ring.js";

const SAMPLES = 1.5e6; // limit of samples kept, of all registers together
const UNPOLLED_S = 5; // how long a value of an unpolled register stays current
const FAILED_LIMIT_MS = 1000; // age (ms) from which a value is old if the newest request failed
const LOOK_MS = 60000; // time in which the gateway reads all registers of a viewed drive
const UNSEEN_MS = 5000; // if frames are further apart than this, plots have a gap
export const LIVE_MS = 1500; // a frame is live for this long; a new frame comes each second at least

// `time` is that of the newest frame, in ms of the gateway's clock. `came` is when the frame arrived, in ms
// of this device's monotonic clock.
export const store = { plant: null, frame: null, time: 0, came: 0, isLost: false, drives: new Map() };
store.lines = new Map();
const watchers = [];

// Register a function that is called when the gateway sends another plant's description.
export function onPlant(what) {
  watchers.push(what);
  if (store.plant) what();
}

// Store a plant's description. A register's value and samples are kept only if its drive and the register are
// unchanged, because the same name may mean another drive now, or a value in another unit.
export function takePlant(plant) {
  const before = store.drives;
  store.plant = plant;
  store.drives = new Map();
  store.lines = new Map(plant.lines.map(line => [line.name, line]));
  for (const line of plant.lines) {
    for (const spec of line.drives) {
      const registers = new Map(spec.registers.map(r => [r.name, r]));
      const old = sameDrive(before.get(spec.name), spec, line);
      const known = what => new Map([...(old?.[what] ?? [])].filter(([r]) => isSame(old, registers, r)));
      store.drives.set(spec.name, {
        spec,
        line,
        registers,
        good: known("good"),
        pasts: known("pasts"),
        newest: new Map(), // by register: {ms, status} of its newest request
        seen: null, // time of the request for the drive's newest value, in ms
      });
    }
  }
  for (const watcher of watchers) watcher();
}

function sameDrive(old, { family, address }, { port }) {
  const isSame = old?.spec.family === family && old.spec.address === address && old.line.port === port;
  return isSame ? old : null;
}

// Return true if a drive's register has the same unit, step and named values as before.
function isSame(before, registers, name) {
  const meaning = ({ unit, step, kind, words } = {}) => JSON.stringify([unit, step, kind, words]);
  return meaning(before.registers.get(name)) === meaning(registers.get(name));
}

// Add the samples of the last minute, so that sparklines are full immediately. `minute` is {drive: {register:
// [[ms, value]]}}.
export function takeMinute(minute) {
  for (const [name, registers] of Object.entries(minute)) {
    const pasts = store.drives.get(name)?.pasts;
    for (const [register, points] of Object.entries(registers)) {
      if (!pasts || pasts.has(register)) continue;
      const ring = new Ring(most());
      for (const [ms, value] of points) ring.add(ms, value ?? NaN);
      pasts.set(register, ring);
    }
  }
}

// Process a frame, or the changes since the previous frame. Values that are newer than before are stored.
export function takeFrame(told) {
  told.alarms?.forEach(withMs);
  const frame = told.since === undefined ? told : merged(store.frame, told);
  const before = store.time;
  store.frame = frame;
  store.time = Date.parse(frame.time);
  store.came = performance.now();
  if (before && store.time - before > UNSEEN_MS) leaveGap(before + 1);
  for (const [name, drive] of store.drives) {
    const { ages_ms = [], values = {}, seen = null } = frame.drives[name] ?? {};
    const at = place => store.time - ages_ms[place];
    drive.seen = seen === null ? null : at(seen);
    drive.newest.clear();
    for (const [register, [value, place, status = "ok", lastValue, lastPlace]] of Object.entries(values))
      keep(drive, register, [value, at(place), status, lastValue, at(lastPlace)]);
  }
}

// Replace an alarm's ISO 8601 times by ms since 1970.
export function withMs(alarm) {
  for (const key of ["time", "ended", "acknowledged"])
    if (alarm[key] !== null) alarm[key] = Date.parse(alarm[key]);
}

// Mark a gap in all plots after this time (ms), because values were missed, for example while the page slept.
function leaveGap(ms) {
  for (const { pasts } of store.drives.values()) for (const ring of pasts.values()) ring.add(ms, NaN);
}

// Return `before` with the values of `changes` in place of its own. Nested objects are merged in the same
// way.
function merged(before, changes) {
  const result = { ...before };
  for (const [key, value] of Object.entries(changes)) {
    const isObject = value !== null && typeof value === "object" && !Array.isArray(value);
    result[key] = isObject ? merged(before[key], value) : value;
  }
  return result;
}

// Store a register's entry of a frame: [value, ms, "ok"], or if the newest read failed: [null, ms, status,
// last good value, its ms].
function keep(drive, register, [value, ms, status, lastValue, lastMs]) {
  drive.newest.set(register, { ms, status });
  if (value !== null) drive.good.set(register, { value, ms });
  else if (!Number.isNaN(lastMs)) drive.good.set(register, { value: lastValue, ms: lastMs });
  if (!drive.pasts.has(register)) drive.pasts.set(register, new Ring(most()));
  const isGood = status === "ok" && value !== null;
  drive.pasts.get(register).add(ms, isGood ? value : NaN);
}

function most() {
  let registers = 0;
  for (const drive of store.drives.values()) registers += Math.max(1, drive.pasts.size);
  return Math.max(120, Math.min(6000, Math.floor(SAMPLES / registers)));
}

// Return the newest value of a register as {value, ms, status, age (ms), isOld}, or null if there never was
// one. `now` is the gateway's time. A value is old if the gateway says so, if the newest read failed and the
// value is more than a second old, or if the frame itself is old. If its time is in the future, the gateway's
// clock was set back.
export function reading(name, register, now) {
  const drive = store.drives.get(name),
    newest = drive?.newest.get(register);
  const good = drive?.good.get(register);
  if (!good) return newest ? { value: null, ...newest, age: now - newest.ms, isOld: true } : null;
  const status = newest ? newest.status : t("no longer polled");
  const age = (isLive(now) ? store.time : now) - good.ms;
  return {
    value: good.value,
    ms: good.ms,
    status,
    age,
    isOld: (status !== "ok" && !(age >= 0 && age <= FAILED_LIMIT_MS)) || !isLive(now),
  };
}

let others = { drive: null, values: {} }; // values of the viewed drive's unpolled registers

// Store the newest values of registers that are not polled: {register: [value, ms, status]}. The gateway
// reads them while the page shows their drive.
export function takeOthers(drive, values) {
  others = { drive, values: values ?? {} };
}

// Return the newest value of a register, whether it is polled or only read while the page shows its drive.
export function known(drive, register, at) {
  const polled = reading(drive, register, at),
    row = others.drive === drive ? others.values[register] : undefined;
  if (polled || !row) return polled;
  const [value, ms, status] = row,
    age = at - ms,
    isSilent = state(drive) === "silent" || !isLive(at);
  return { value, ms, status, age, isOld: status !== "ok" || age > LOOK_MS || isSilent };
}

// Return for how long a value of a register stays current, in ms.
export const holdsFor = (name, register) =>
  1000 * (store.drives.get(name)?.registers.get(register)?.holds_s ?? UNPOLLED_S);

export const isLive = now => store.frame !== null && !store.isLost && now - store.time < LIVE_MS;

// Return the age, in ms, of a drive's newest good reply, or null if there is none.
export function driveAge(name, now) {
  const seen = store.drives.get(name)?.seen ?? null;
  return seen === null ? null : Math.max(0, (isLive(now) ? store.time : now) - seen);
}

// Return the number of a drive's stops so far.
export const stops = name => store.frame?.drives[name]?.stops ?? 0;

// Return a drive's state. Return "still" if the state is unknown and the frequency is 0: the motor is at
// rest, or it runs with setpoint 0.
export function state(name) {
  const drive = store.frame?.drives[name],
    is = drive?.state ?? "unknown";
  return is === "unknown" && drive?.values?.[key(name, "frequency")]?.[0] === 0 ? "still" : is;
}

// Return a note about a drive's state, such as why it is unknown.
export const noteOf = name => store.frame?.drives[name]?.note ?? "";

// Return the name of a drive's register for a purpose such as "frequency", or null.
export const key = (name, part) => store.drives.get(name)?.spec.key?.[part] ?? null;

// Return the newest frame's alarms: active ones first, and the most serious kind first among them.
export const alarms = () => store.frame?.alarms ?? [];

export const lasting = () => alarms().filter(alarm => alarm.ended === null);

// Return true if the page's user may write this register of a drive, or send this verb to the drive.
export const mayWrite = (drive, register) =>
  store.plant?.may?.write?.includes(`${drive}.${register}`) ?? false;
export const mayAct = (drive, verb) => store.plant?.may?.verbs?.includes(`${drive}.${verb}`) ?? false;
