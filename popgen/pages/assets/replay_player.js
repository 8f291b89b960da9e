// Plays recorded games (popgen-replay, see popgen/pages/replay_files.py) on canvases under one slider.

/** Loads all tiles of an atlas as one picture. */
export function loadAtlas(url) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error("the tiles cannot be read"));
    image.src = url;
  });
}

/** All tile numbers of every frame: changes added up. */
export function unfoldFrames(game, cells) {
  const frames = [];
  let tiles = new Uint32Array(cells);
  for (const changes of game.frames) {
    tiles = tiles.slice();
    for (let i = 0; i < changes.length; i += 2) tiles[changes[i]] = changes[i + 1];
    frames.push(tiles);
  }
  return frames;
}

/** Score after each step. */
export function addGains(game) {
  const scores = new Float64Array(game.frames.length);
  for (const [step, gain] of game.gains) scores[step] += gain;
  for (let t = 1; t < scores.length; t += 1) scores[t] += scores[t - 1];
  return scores;
}

function formatNumber(value) {
  return Number.isInteger(value) ? String(value) : value.toFixed(2);
}

/** One picture with its caption. */
class Board {
  constructor(root, replay, atlas) {
    this.root = root;
    this.replay = replay;
    this.atlas = atlas;
    this.canvas = root.querySelector("canvas");
    this.canvas.width = replay.columns * replay.tile;
    this.canvas.height = replay.rows * replay.tile;
    this.caption = root.querySelector("figcaption");
    this.choose(Number(root.dataset.game));
  }

  choose(number) {
    this.game = this.replay.games[number];
    this.frames = unfoldFrames(this.game, this.replay.rows * this.replay.columns);
    this.scores = addGains(this.game);
  }

  get last() {
    return this.frames.length - 1;
  }

  draw(step) {
    const { tile, columns, across } = this.replay;
    const t = Math.min(step, this.last);
    const context = this.canvas.getContext("2d");
    this.frames[t].forEach((number, cell) => {
      const x = (number % across) * tile;
      const y = Math.floor(number / across) * tile;
      context.drawImage(this.atlas, x, y, tile, tile, (cell % columns) * tile, Math.floor(cell / columns) * tile, tile, tile);
    });
    const lines = this.game.players.map((label, seat) => this.tellSeat(label, seat, t));
    const score = document.createElement("div");
    score.textContent = `step ${t} of ${this.last}, ${formatNumber(this.scores[t])} ${this.replay.unit}`;
    this.caption.replaceChildren(score, ...lines);
    this.canvas.setAttribute("aria-label", `${this.caption.innerText}`);
  }

  /** Who sits there, its last action and the last thing that it did. */
  tellSeat(label, seat, t) {
    const line = document.createElement("div");
    const mark = document.createElement("span");
    mark.className = `seat seat${seat}`;
    mark.textContent = String(seat + 1);
    const name = /^\d+$/.test(label) ? `member ${label}` : label;
    const action = t > 0 ? this.replay.actions[this.game.actions[seat][t - 1]] : "";
    const did = this.game.happened.filter(([step, who]) => who === seat && step <= t).at(-1);
    const event = did ? `, last: ${this.replay.events[did[2]].replaceAll("_", " ")} (step ${did[0]})` : "";
    line.append(mark, ` ${name} (seat ${seat}) ${action}${event}`);
    return line;
  }
}

/** Boards that share a slider, a button and a speed. */
class Stage {
  constructor(root, replay, atlas) {
    this.boards = [...root.querySelectorAll(".board")].map((board) => new Board(board, replay, atlas));
    this.slider = root.querySelector("input[type=range]");
    this.button = root.querySelector("button");
    this.output = root.querySelector("output");
    this.speed = root.querySelector("select.speed");
    this.milliseconds = Number(root.dataset.milliseconds);
    this.timer = null;
    this.slider.addEventListener("input", () => { this.stop(); this.draw(); });
    this.button.addEventListener("click", () => (this.timer ? this.stop() : this.start()));
    for (const board of this.boards) {
      board.root.querySelector("select")?.addEventListener("change", (event) => {
        board.choose(Number(event.target.value));
        this.fit();
      });
    }
    this.fit();
  }

  fit() {
    this.slider.max = String(Math.max(...this.boards.map((board) => board.last)));
    this.draw();
  }

  get step() {
    return Number(this.slider.value);
  }

  draw() {
    for (const board of this.boards) board.draw(this.step);
    const text = `step ${this.step} of ${this.slider.max}`;
    this.output.textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
  }

  start() {
    if (this.step >= Number(this.slider.max)) this.slider.value = "0";
    this.button.textContent = "Pause";
    this.advance();
  }

  advance() {
    this.timer = setTimeout(() => {
      this.slider.value = String(this.step + 1);
      this.draw();
      if (this.step >= Number(this.slider.max)) this.stop();
      else this.advance();
    }, this.milliseconds / Number(this.speed.value));
  }

  stop() {
    clearTimeout(this.timer);
    this.timer = null;
    this.button.textContent = "Play";
  }
}

const source = document.getElementById("replay");
if (source) {
  const replay = JSON.parse(source.textContent);
  const atlas = await loadAtlas(replay.atlas);
  for (const root of document.querySelectorAll(".stage")) new Stage(root, replay, atlas);
  document.body.dataset.ready = "true";
}
