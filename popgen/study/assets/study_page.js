// The pages of a study: shows the station where the participant is, and goes on from there.
import { playGame } from "./study_game.js";

const main = document.getElementById("main");
const AGREEMENT = 7;

export function make(tag, text = "", given = {}) {
  const element = document.createElement(tag);
  element.textContent = text;
  for (const [name, value] of Object.entries(given)) element.setAttribute(name, value);
  return element;
}

async function send(name, body) {
  const answer = await fetch(`api/${name}`, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  return { status: answer.status, ...(await answer.json().catch(() => ({}))) };
}

// A few marks of Markdown: headings, paragraphs, **strong** and *emphasis*.
function showText(text, place) {
  for (const block of text.split(/\n\s*\n/)) {
    const heading = /^(#+)\s+(.*)$/.exec(block.trim());
    const element = make(heading ? "h2" : "p");
    for (const part of (heading ? heading[2] : block).split(/(\*\*[^*]+\*\*|\*[^*]+\*)/)) {
      const mark = /^(\*+)(.*?)\*+$/s.exec(part);
      element.append(mark ? make(mark[1].length === 2 ? "strong" : "em", mark[2]) : part);
    }
    place.append(element);
  }
}

function open(heading) {
  const element = make("h2", heading, { tabindex: "-1" });
  main.replaceChildren(element);
  element.focus();
  scrollTo(0, 0);
}

function addButton(text, act) {
  const button = make("button", text, { type: "button" });
  button.addEventListener("click", async () => {
    button.disabled = true;
    await act();
    button.disabled = false;
  });
  main.append(button, " ");
  return button;
}

async function refused(answer) {
  const reasons = {
    taken: "Somebody with your number has begun this study already. Go on in the browser in which you began.",
    full: "This study has no places left. Thank you for your interest.",
    outdated: "The text has changed. Please read it again.",
  };
  if (answer.refused in reasons) {
    open("This does not work");
    main.append(make("p", reasons[answer.refused]));
    return true;
  }
  return false;
}

async function begin() {
  const query = new URLSearchParams(location.search);
  const recruit = query.get("PROLIFIC_PID");
  const answer = await send("session", recruit ? { recruit: recruit.slice(0, 100) } : {});
  history.replaceState(null, "", location.pathname); // the number stays in no history
  if (!(await refused(answer))) await show();
}

const pages = {
  consent(state) {
    open("Before you begin");
    showText(state.text, main);
    const decide = (agreed) => async () => {
      const answer = await send("consent", { agreed, version: state.version });
      if (!(await refused(answer))) await show();
    };
    addButton("I agree and take part", decide(true));
    addButton("I do not take part", decide(false));
  },
  instructions(state) {
    open("How to play");
    listInstructions(state);
    addButton("I have read this", async () => {
      await send("instructions", {});
      await show();
    });
  },
  check(state) {
    open("A few questions about the game");
    showForm(state, "Go on");
    const again = make("details");
    again.append(make("summary", "Read the instructions again"));
    main.append(again);
    listInstructions(state, again);
  },
  game(state) {
    open(state.practice ? `Practice game ${state.number} of ${state.of}` : `Pair ${state.pair}: ` +
      `the ${state.position === 1 ? "first" : "second"} partner`);
    playGame(main, state, show, make);
  },
  items(state) {
    open("About your last two partners");
    showForm(state, "Go on");
  },
  demographics(state) {
    open("About you");
    showForm(state, "Finish");
  },
};

function listInstructions(state, place = main) {
  const list = make("ol");
  for (const text of state.instructions) list.append(make("li", text));
  place.append(list);
}

function showForm(state, submit) {
  const form = make("form");
  state.questions.forEach((question) => {
    const group = make("fieldset");
    const options = make("div", "", { class: "options" });
    group.append(make("legend", question.text), options);
    question.options.forEach((option, index) => {
      const label = make("label");
      const choice = make("input", "", { type: "radio", name: question.key, value: option, required: "" });
      const told = question.options.length === AGREEMENT ? `${index + 1} ${option}` : option;
      label.append(choice, told);
      options.append(label);
    });
    form.append(group);
  });
  const notice = make("p", "", { role: "status" });
  form.append(notice, make("button", submit, { type: "submit" }));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const answers = Object.fromEntries(new FormData(form));
    const answer = await send("answers", { form: state.form, answers });
    if (answer.passed === false) {
      notice.className = "notice strong";
      notice.textContent = "Not all answers are right. Please read the instructions again and correct them.";
      return;
    }
    await show();
  });
  main.append(form);
}

function showEnd(state) {
  const told = {
    completed: ["Thank you", "You have finished the study."],
    declined: ["Thank you for your interest", "You do not take part. Nothing about you was recorded."],
    inactive: ["The study has ended", "Two games ended because no key was pressed."],
    away: ["The study has ended", "You were away for too long, and somebody else has your place."],
    withdrawn: ["You have stopped", "You take part no longer. What was recorded until now is kept."],
  };
  const [heading, text] = told[state.status];
  open(heading);
  main.append(make("p", text));
  if (state.completion) {
    main.append(make("p", "Your completion code:"), make("p", state.completion, { class: "code", id: "completion" }));
  }
  const later = make("p", "To have your records deleted, use this page or your participant code ");
  later.append(make("code", state.code), ".");
  main.append(later);
}

export async function show() {
  const answer = await fetch("api/state");
  if (!answer.ok) {
    main.replaceChildren(make("p", "The server does not answer. Please reload this page in a moment."));
    return;
  }
  const state = await answer.json();
  document.title = state.title;
  document.getElementById("title").textContent = state.title;
  if (state.status === "new") return begin();
  const active = state.status === "active";
  document.getElementById("progress").textContent = active ? `Part ${state.place + 1} of ${state.places}` : "";
  document.getElementById("code").textContent = state.code;
  document.getElementById("foot").hidden = state.kind === "consent";
  document.getElementById("stop").hidden = !active;
  document.getElementById("leave").open = false;
  document.body.dataset.kind = active ? state.kind : "over";
  document.body.dataset.place = state.place;
  if (active) pages[state.kind](state);
  else showEnd(state);
}

async function leave(remove) {
  const question = remove ? "Delete everything that was recorded of you?" : "Stop taking part?";
  if (!confirm(question)) return;
  await send("withdraw", { delete: remove });
  if (remove) {
    document.getElementById("foot").hidden = true;
    document.body.dataset.kind = "deleted";
    open("Your records are deleted");
    main.append(make("p", "Nothing of you is left in the records. You can close this page."));
  } else await show();
}

document.getElementById("stop").addEventListener("click", () => leave(false));
document.getElementById("delete").addEventListener("click", () => leave(true));
await show();
