// A game: draws what the server tells and sends keys with their times (popgen/study/game_host.py), or plays here and
// sends what was played (browser_game.js).
import { openBrowserGame } from "./browser_game.js";

const TILE = 32;
const CODES = {
  ArrowUp: "ArrowUp", ArrowDown: "ArrowDown", ArrowLeft: "ArrowLeft", ArrowRight: "ArrowRight", Space: "Space",
  KeyW: "ArrowUp", KeyS: "ArrowDown", KeyA: "ArrowLeft", KeyD: "ArrowRight",
};
let current = null;

function loadTile(url) {
  const image = new Image();
  image.src = url;
  return image.decode().then(() => image);
}

class Game {
  constructor(place, state, onOver, make) {
    this.state = state;
    this.onOver = onOver;
    this.tiles = new Map();
    this.queue = Promise.resolve();
    this.running = false;
    this.over = false;
    this.score = 0;
    this.canvas = make("canvas", "", {
      class: "kitchen", tabindex: "0", role: "application", width: "160", height: "128",
      "aria-label": "the kitchen: arrow keys move, Space takes, puts down and uses",
    });
    this.time = make("span", "");
    this.points = make("span", "");
    this.notice = make("p", "Connecting.", { role: "status", class: "notice" });
    const bar = make("div", "", { class: "bar" });
    this.seat = make("span", "");
    bar.append(this.points, this.time, this.seat);
    place.append(this.notice, bar, this.canvas);
    place.append(make("p", "Arrow keys (or W, A, S, D) move, Space takes, puts down and uses."));
    this.listen();
    this.connect();
  }

  listen() {
    this.canvas.addEventListener("keydown", (event) => this.key(event, 1));
    this.canvas.addEventListener("keyup", (event) => this.key(event, 0));
    this.canvas.addEventListener("blur", () => this.release());
    this.canvas.addEventListener("focus", () => this.running || this.tell());
    this.onHidden = () => document.hidden && this.running && this.hide();
    document.addEventListener("visibilitychange", this.onHidden);
  }

  connect() {
    const address = new URL("api/game", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(address);
    this.socket.addEventListener("message", (event) => {
      const told = JSON.parse(event.data);
      this.queue = this.queue.then(() => this.take(told));
    });
    this.socket.addEventListener("close", (event) => this.queue.then(() => this.closed(event.code)));
  }

  send(told) {
    const open = this.socket.readyState === WebSocket.OPEN;
    if (open) this.socket.send(JSON.stringify(told));
    return open;
  }

  hide() {
    if (!this.local) {
      this.send({ hidden: true });
      return;
    }
    this.local.pause();
    this.running = false;
    this.tell();
  }

  say(text, strong = false) {
    this.notice.textContent = text;
    this.notice.classList.toggle("strong", strong);
  }

  tell() {
    if (this.over || !this.begun) return;
    this.say(this.step ? "The game waits. Press Space to go on." : "Press Space to start the game.");
  }

  async take(told) {
    if (told.begin?.host === "browser") this.local = await openBrowserGame(told, this);
    if (told.begin) this.begin(told.begin);
    if (told.begin && this.local) this.showStep(this.local);
    if (told.kept !== undefined) this.local?.keep(told.kept);
    if (told.tiles) {
      const images = await Promise.all(told.tiles.map((tile) => loadTile(tile[1])));
      told.tiles.forEach((tile, index) => this.tiles.set(tile[0], images[index]));
    }
    if (told.cells) this.draw(told);
    if (told.begin) this.tell();
    if (told.paused) {
      this.running = false;
      this.tell();
    }
    if (told.warning) this.warn(told.warning);
    if (told.over) await this.finish(told);
  }

  warn(seconds) {
    this.say(`Are you there? Without a key the game ends in ${seconds} seconds.`, true);
  }

  stall(waits = true) {
    if (waits) this.say("The game waits for the server.", true);
    else this.say("The game is on.");
  }

  begin(told) {
    this.begun = told;
    this.canvas.width = told.columns * TILE;
    this.canvas.height = told.rows * TILE;
    this.canvas.style.aspectRatio = `${told.columns} / ${told.rows}`;
    const room = `calc(max(10rem, 100vh - 15rem) * ${told.columns / told.rows})`; // the whole kitchen is in sight
    this.canvas.style.width = `min(100%, ${told.columns * TILE * 3}px, ${room})`;
    this.seat.textContent = `You are cook ${told.seat + 1} (${told.seat ? "orange" : "blue"}).`;
    this.canvas.focus();
  }

  draw(told) {
    const context = this.canvas.getContext("2d");
    const columns = this.begun.columns;
    for (let i = 0; i < told.cells.length; i += 2) {
      const cell = told.cells[i];
      context.drawImage(this.tiles.get(told.cells[i + 1]), (cell % columns) * TILE, Math.floor(cell / columns) * TILE);
    }
    if (told.step && told.step % 4 === 0) this.send({ seen: told.step });
    this.showNumbers(told);
  }

  showStep(local) {
    local.draw(this.canvas.getContext("2d"), TILE);
    this.showNumbers(local);
  }

  showNumbers(told) {
    this.step = told.step;
    const left = Math.ceil(((this.begun.steps - told.step) * this.state.step_ms) / 1000);
    this.time.textContent = `Time left: ${left} s`;
    this.points.textContent = `Soups: ${told.score}`;
    if (told.score > this.score) this.say(`Soup delivered. Soups: ${told.score}.`);
    this.score = told.score;
  }

  key(event, down) {
    const code = CODES[event.code];
    if (!code || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (event.repeat || this.over || !this.begun) return;
    if (!this.running) {
      if (down && code === "Space") {
        this.running = true;
        this.say("The game is on.");
        this.send({ go: true });
        this.local?.start();
      }
      return;
    }
    if (this.notice.classList.contains("strong")) this.say("The game is on.");
    this.sendKeys([[code, down, Math.round(event.timeStamp * 10) / 10]]);
  }

  sendKeys(keys) {
    if (this.local) for (const key of keys) this.local.key(...key);
    else this.send({ keys });
  }

  release() {
    if (!this.running || this.over) return;
    const codes = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight", "Space"];
    this.sendKeys(codes.map((code) => [code, 0, Math.round(performance.now() * 10) / 10]));
    this.say("The game runs on. Click the kitchen or press Tab until it has the frame, to play.", true);
  }

  async finish(told) {
    this.over = true;
    this.running = false;
    this.local?.pause();
    const texts = {
      finished: `The game is over. Soups: ${told.score}.`,
      void: "The game ended because no key was pressed.",
      failed: "Something went wrong. Please reload this page.",
    };
    this.say(texts[told.over], told.over !== "finished");
    if (told.over === "failed") return;
    const button = document.createElement("button");
    button.textContent = "Go on";
    button.addEventListener("click", () => this.onOver());
    this.canvas.after(button); // without the focus: a key that was meant for the game must not press it
  }

  closed(code) {
    document.removeEventListener("visibilitychange", this.onHidden);
    this.running = false;
    this.local?.pause();
    if (this.over || current !== this) return;
    this.over = true;
    if (code === 4000) this.onOver();
    else if (code === 4001) this.say("The game goes on in another tab or window.", true);
    else if (code === 1006 || code === 1012 || code === 1001) this.reconnect();
    else this.say("The connection ended. Please reload this page.", true);
  }

  reconnect() {
    this.say("The connection is lost. Trying again.", true);
    const again = async () => {
      const answer = await fetch("api/state").catch(() => null);
      if (answer?.ok) this.onOver();
      else setTimeout(again, 1000);
    };
    setTimeout(again, 500);
  }
}

export function playGame(place, state, onOver, make) {
  if (current && !current.over) {
    current.over = true;
    current.local?.pause();
    current.socket.close();
  }
  current = new Game(place, state, onOver, make);
}
