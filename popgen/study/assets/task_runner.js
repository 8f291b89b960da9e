// Works on what popgen/study/script_engine.py asks, in a browser or in Node: fetches a task, answers, fetches the next.
import { Partner } from "./ego_network.js";
import { Kitchen, listTiles } from "./kitchen_rules.js";

// Rows of a state and two actions -> rows of the next state, reward (4 bytes), score, truncated, events of both
// players, and `features` of both players before the step.
function playTransitions(told, bytes) {
  const kitchen = new Kitchen(told.kitchen);
  const size = kitchen.size;
  const count = bytes.length / (size + 2);
  const events = 2 * told.kitchen.events;
  const width = size + 6 + events + 2 * kitchen.features;
  const out = new Uint8Array(count * width);
  const view = new DataView(out.buffer);
  for (let row = 0; row < count; row++) {
    const from = row * (size + 2);
    const state = bytes.slice(from, from + size);
    let at = row * width;
    kitchen.encode(state, out.subarray(at + size + 6 + events, at + width));
    const result = kitchen.step(state, [bytes[from + size], bytes[from + size + 1]]);
    out.set(state, at);
    at += size;
    view.setFloat32(at, result.reward, true);
    out[at + 4] = result.score;
    out[at + 5] = result.truncated ? 1 : 0;
    out.set(result.events[0], at + 6);
    out.set(result.events[1], at + 6 + events / 2);
  }
  return out;
}

// Games of a partner with recorded actions of a person, one byte a step, before the partner's file -> its action and
// its probabilities (float64) at each step.
function playPartner(told, bytes) {
  const kitchen = new Kitchen(told.kitchen);
  const steps = told.games * told.steps;
  const partner = new Partner(bytes.slice(steps).buffer, told.kitchen.actions.length, kitchen.features);
  const width = 1 + 8 * told.kitchen.actions.length;
  const out = new Uint8Array(steps * width);
  for (let game = 0; game < told.games; game++) {
    const state = kitchen.start.slice();
    const seat = game % 2;
    let previous = null;
    partner.begin(seat, told.generators[game]);
    for (let step = 0; step < told.steps; step++) {
      const row = game * told.steps + step;
      const action = partner.act(kitchen.encode(state), previous);
      previous = seat ? [bytes[row], action] : [action, bytes[row]];
      out[row * width] = action;
      out.set(new Uint8Array(partner.probabilities.slice().buffer), row * width + 1);
      kitchen.step(state, previous);
    }
  }
  return out;
}

// States -> numbers of tiles (2 bytes each), cell by cell.
function lookAtStates(told, bytes) {
  const kitchen = new Kitchen(told.kitchen);
  const numbers = [];
  for (let at = 0; at < bytes.length; at += kitchen.size) {
    numbers.push(...listTiles(kitchen, bytes.subarray(at, at + kitchen.size)));
  }
  return new Uint8Array(Uint16Array.from(numbers).buffer);
}

const tasks = { transitions: playTransitions, partner: playPartner, tiles: lookAtStates };

// A task is the length of its JSON (4 bytes), the JSON, and bytes.
export async function workOn(address) {
  for (;;) {
    const answer = await fetch(`${address}/next`);
    if (answer.status !== 200) return;
    const whole = new Uint8Array(await answer.arrayBuffer());
    const length = new DataView(whole.buffer).getUint32(0, true);
    const told = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
    const body = tasks[told.task](told, whole.subarray(4 + length));
    await fetch(`${address}/result`, { method: "POST", body });
  }
}
