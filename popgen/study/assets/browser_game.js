// A game whose rules and partner run on this page. Steps follow the page's clock; the server gets them in small batches
// and proves them. See popgen/study/browser_host.py.
import { Partner } from "./ego_network.js";
import { Kitchen, listTiles } from "./kitchen_rules.js";

const BATCH = 2; // steps that are sent together
const MOST_STEPS = 4; // of one message
const AHEAD = 1000; // milliseconds of play that may be on this page alone
const MOST_KEYS = 16; // events of one step
const ACTIONS = { ArrowUp: "north", ArrowDown: "south", ArrowLeft: "west", ArrowRight: "east", Space: "interact" };

const kitchens = new Map();
let latest = null; // the game goes on where it was after a lost connection

async function loadKitchen(layout) {
  if (!kitchens.has(layout)) {
    const told = await (await fetch("api/kitchen")).json();
    const atlas = new Image();
    atlas.src = told.tiles.url;
    await atlas.decode();
    kitchens.set(layout, { kitchen: new Kitchen(told), atlas });
  }
  return kitchens.get(layout);
}

// told: the server's first message; screen: `showStep`, `send`, `warn` and `stall`.
export async function openBrowserGame(told, screen) {
  const begun = told.begin;
  const known = latest && latest.begun.generator.join() === begun.generator.join() && latest.step >= told.step;
  if (!known) {
    const { kitchen, atlas } = await loadKitchen(begun.layout);
    const file = await (await fetch("api/partner")).arrayBuffer();
    latest = new BrowserGame(kitchen, atlas, new Partner(file, kitchen.told.actions.length, kitchen.features), begun);
    latest.repeat(begun.actions);
  }
  latest.attach(screen, told.step);
  return latest;
}

class BrowserGame {
  constructor(kitchen, atlas, partner, begun) {
    Object.assign(this, { kitchen, atlas, partner, begun });
    this.state = kitchen.start.slice();
    this.previous = null;
    this.step = 0;
    this.score = 0;
    this.kept = 0;
    this.rows = []; // steps that are not known to be recorded
    this.sent = 0; // the first step that was not sent
    this.elapsed = begun.elapsed_ms - performance.now();
    this.held = [];
    this.pressed = null;
    this.keys = [];
    this.running = false;
    partner.begin(1 - begun.seat, begun.generator);
  }

  // Plays recorded joint actions again.
  repeat(actions) {
    for (const joint of actions) {
      const ego = this.partner.act(this.kitchen.encode(this.state), this.previous);
      if (ego !== joint[1 - this.begun.seat]) throw new Error(`step ${this.step} is not the partner's`);
      this.advance(joint);
    }
    this.kept = this.sent = this.step;
  }

  advance(joint) {
    this.score += this.kitchen.step(this.state, joint).score;
    this.previous = joint;
    this.step++;
  }

  attach(screen, recorded) {
    this.screen = screen;
    this.keep(recorded);
    this.sent = recorded;
    this.shown = null;
    this.asked = null;
    this.latency = null;
    this.flush();
  }

  start() {
    this.running = true;
    this.stalled = false;
    this.idle = 0;
    this.flush();
    this.due = performance.now() + this.begun.step_ms;
    this.wait();
  }

  pause() {
    this.running = false;
    this.held = [];
    this.pressed = null;
    clearTimeout(this.timer);
    this.flush();
  }

  wait() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.play(), Math.max(0, this.due - performance.now()));
  }

  key(code, down, at) {
    const action = this.kitchen.told.actions.indexOf(ACTIONS[code]);
    if (down && !this.held.includes(action)) {
      this.held.push(action);
      this.pressed = action;
    } else if (!down) this.held = this.held.filter((one) => one !== action);
    if (this.keys.length < MOST_KEYS) this.keys.push([code, down, at]);
    this.idle = 0;
  }

  takeAction() {
    const action = this.pressed ?? this.held.at(-1) ?? this.kitchen.names.STAY;
    this.pressed = null;
    return action;
  }

  play() {
    if (!this.running || this.step >= this.begun.steps) return;
    const now = performance.now();
    const own = this.takeAction();
    const ego = this.partner.act(this.kitchen.encode(this.state), this.previous);
    const joint = this.begun.seat ? [ego, own] : [own, ego];
    const state = Array.from(this.state, (byte) => byte.toString(16).padStart(2, "0")).join("");
    const late = Math.round(Math.max(0, now - this.due) * 1000);
    this.rows.push([this.step, state, ...joint, Math.round(this.elapsed + now), late, this.keys]);
    this.keys = [];
    this.advance(joint);
    this.idle++;
    this.screen.showStep(this);
    const { steps, warn_steps: warn, end_steps: end, step_ms: period } = this.begun;
    const over = this.step >= steps || this.idle >= end;
    if (over || this.step - this.sent >= BATCH) this.flush();
    if (over) {
      this.running = false;
      return;
    }
    if (this.idle === warn) this.screen.warn(Math.round((end - warn) * period) / 1000);
    this.due += period;
    if (now - this.due > period) this.due = now;
    if ((this.step - this.kept) * period >= AHEAD) {
      this.stalled = true;
      this.screen.stall();
    } else this.wait();
  }

  flush() {
    const rows = this.rows.filter((row) => row[0] >= this.sent);
    for (let at = 0; at < rows.length; at += MOST_STEPS) {
      const told = { steps: rows.slice(at, at + MOST_STEPS) };
      if (this.latency !== null) told.latency = this.latency;
      this.latency = null;
      if (!this.screen.send(told)) return;
      this.sent = told.steps.at(-1)[0] + 1;
      this.asked ??= { step: this.sent, at: performance.now() };
    }
  }

  // The server has recorded the steps before `step`.
  keep(step) {
    this.kept = step;
    this.rows = this.rows.filter((row) => row[0] >= step);
    if (this.asked && step >= this.asked.step) {
      this.latency = Math.round((performance.now() - this.asked.at) * 10) / 10;
      this.asked = null;
    }
    if (this.stalled && this.running) {
      this.stalled = false;
      this.due = performance.now() + this.begun.step_ms;
      this.screen.stall(false);
      this.wait();
    }
  }

  draw(context, side) {
    const { across } = this.kitchen.told.tiles;
    const columns = this.begun.columns;
    const cells = listTiles(this.kitchen, this.state);
    cells.forEach((number, cell) => {
      if (this.shown?.[cell] === number) return;
      const [from, top] = [(number % across) * side, Math.floor(number / across) * side];
      const [x, y] = [(cell % columns) * side, Math.floor(cell / columns) * side];
      context.drawImage(this.atlas, from, top, side, side, x, y, side, side);
    });
    this.shown = cells;
  }
}
