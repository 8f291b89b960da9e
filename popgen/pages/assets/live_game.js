// A game with a member: draws what the server tells, and sends keys (see popgen/pages/game_server.py).

const settings = JSON.parse(document.getElementById("settings").textContent);
const canvas = document.querySelector("canvas");
const status = document.getElementById("status");
const figures = document.getElementById("figures");
const form = document.querySelector("form");
const TILE = 32;

let tiles = [];
let socket = null;
let playing = false;
let score = 0;
let queue = Promise.resolve();

function loadTile(url) {
  const image = new Image();
  image.src = url;
  return image.decode().then(() => image);
}

function connect() {
  const address = new URL("game", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(address);
  socket.addEventListener("message", (event) => {
    const told = JSON.parse(event.data);
    queue = queue.then(() => show(told));
  });
  socket.addEventListener("close", (event) => {
    playing = false;
    status.textContent = event.reason || "The server has gone; start popgen play again and reload this page.";
  });
  return new Promise((resolve) => socket.addEventListener("open", resolve, { once: true }));
}

async function show(told) {
  tiles.push(...(await Promise.all(told.tiles.map(loadTile))));
  if (told.step === 0) {
    canvas.width = told.columns * TILE;
    canvas.height = told.rows * TILE;
    score = 0;
  }
  const context = canvas.getContext("2d");
  for (let i = 0; i < told.cells.length; i += 2) {
    const cell = told.cells[i];
    context.drawImage(tiles[told.cells[i + 1]], (cell % told.columns) * TILE, Math.floor(cell / told.columns) * TILE);
  }
  const points = Number.isInteger(told.score) ? told.score : told.score.toFixed(2);
  figures.textContent = `step ${told.step} of ${told.horizon}, ${points} ${told.unit}`;
  if (told.score !== score && Number.isInteger(told.score)) status.textContent = `${told.score} ${told.unit}`;
  score = told.score;
  if (told.over) {
    playing = false;
    status.textContent = `The game is over: ${points} ${told.unit}.`;
    document.getElementById("again").hidden = false;
  }
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  if (!socket || socket.readyState !== WebSocket.OPEN) await connect();
  await queue;
  tiles = [];
  const chosen = new FormData(form);
  socket.send(JSON.stringify({ start: { partner: chosen.get("partner"), seat: Number(chosen.get("seat")) } }));
  playing = true;
  document.getElementById("again").hidden = true;
  status.textContent = "The game has begun.";
  canvas.focus();
});

function send(what, event) {
  if (!playing || !settings.keys.includes(event.code)) return;
  event.preventDefault();
  if (!event.repeat) socket.send(JSON.stringify({ [what]: event.code }));
}

canvas.addEventListener("keydown", (event) => send("press", event));
canvas.addEventListener("keyup", (event) => send("release", event));
canvas.addEventListener("blur", () => {
  if (playing) for (const code of settings.keys) socket.send(JSON.stringify({ release: code }));
});
document.body.dataset.ready = "true";
