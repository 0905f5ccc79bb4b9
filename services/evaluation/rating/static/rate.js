// The rating page: plays a rollout, takes marks by mouse or keyboard, and asks for the next one.

const at = (id) => document.getElementById(id);
let rater = null;
let key = "";
let shown = null;
let pictures = [];
let marks = {};
let step = 0;
let playing = true;
let lastDraw = 0;

async function request(path, options = {}) {
  const headers = { ...(options.headers ?? {}) };
  if (key) headers.authorization = `Bearer ${key}`;
  const answer = await fetch(path, { ...options, headers });
  if (!answer.ok) {
    const problem = await answer.json().catch(() => ({}));
    throw new Error(problem.detail ?? `${answer.status} ${answer.statusText}`);
  }
  return answer;
}

async function attempt(work) {
  at("problem").textContent = "";
  try {
    await work();
  } catch (error) {
    at("problem").textContent = error.message;
  }
}

async function next() {
  const answer = await request(`/v1/rating/next?rater=${encodeURIComponent(rater)}`);
  if (answer.status === 204) {
    shown = null;
    at("rating").hidden = true;
    at("progress").textContent = "Everything is rated. Thank you.";
    return;
  }
  shown = await answer.json();
  marks = {};
  step = 0;
  playing = true;
  pictures = new Array(shown.num_steps).fill(null);
  at("progress").textContent = `${rater}: ${shown.num_done} rated, ${shown.num_open} to go`;
  at("instruction").textContent = shown.instruction;
  at("is_inconsistent").checked = false;
  at("comment").value = "";
  at("step").max = shown.num_steps - 1;
  listCriteria();
  at("rating").hidden = false;
  refresh();
  void load(shown);
}

async function load(rollout) {
  for (let index = 0; index < rollout.num_steps; index += 1) {
    if (shown !== rollout) return;
    try {
      const answer = await request(`/v1/rating/rollouts/${rollout.rollout}/steps/${index}.jpg`);
      pictures[index] = await createImageBitmap(await answer.blob());
    } catch (error) {
      if (shown === rollout) at("problem").textContent = `step ${index}: ${error.message}`;
      return;
    }
    if (index === step) draw();
  }
}

function listCriteria() {
  const rows = shown.criteria.map((criterion, index) => {
    const row = document.createElement("div");
    row.className = "criterion";
    const text = document.createElement("span");
    const hint = document.createElement("kbd");
    hint.textContent = `${index + 1}`;
    text.append(hint, ` ${criterion.description}${criterion.latched ? "" : " (at the end)"}`);
    const choice = document.createElement("span");
    choice.className = "choice";
    for (const value of [true, false]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = value ? "Yes" : "No";
      button.dataset.criterion = criterion.name;
      button.dataset.value = `${value}`;
      button.addEventListener("click", () => set(criterion.name, value));
      choice.append(button);
    }
    row.append(text, choice);
    return row;
  });
  const legend = at("criteria").firstElementChild;
  at("criteria").replaceChildren(legend, ...rows);
}

function set(name, value) {
  marks[name] = value;
  refresh();
}

function refresh() {
  for (const button of document.querySelectorAll(".choice button")) {
    const chosen = `${marks[button.dataset.criterion]}` === button.dataset.value;
    button.setAttribute("aria-pressed", `${chosen}`);
  }
  at("save").disabled = shown.criteria.some(({ name }) => marks[name] === undefined);
  at("play").firstChild.textContent = playing ? "Pause " : "Play ";
}

function draw() {
  // An image may arrive after its rollout was left.
  if (!shown) return;
  const picture = pictures[step];
  at("step").value = step;
  at("time").textContent = `${(step / shown.rate_hz).toFixed(1)} s`;
  if (!picture) return;
  const canvas = at("picture");
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  canvas.getContext("2d").drawImage(picture, 0, 0);
}

function tick(now) {
  requestAnimationFrame(tick);
  if (!shown || !playing) return;
  if (now - lastDraw < 1000 / (shown.rate_hz * Number(at("speed").value))) return;
  lastDraw = now;
  const following = (step + 1) % shown.num_steps;
  if (pictures[following]) step = following;
  draw();
}

function move(to) {
  playing = false;
  step = Math.min(Math.max(to, 0), shown.num_steps - 1);
  draw();
  refresh();
}

async function save(cannotJudge) {
  const body = {
    rater,
    rollout: shown.rollout,
    presentation: shown.presentation,
    holds: cannotJudge ? {} : marks,
    is_inconsistent: !cannotJudge && at("is_inconsistent").checked,
    cannot_judge: cannotJudge,
    comment: at("comment").value,
  };
  await request("/v1/rating/marks", {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
  });
  await next();
}

at("enter").addEventListener("submit", (event) => {
  event.preventDefault();
  void attempt(async () => {
    rater = at("rater").value;
    key = at("key").value;
    await next();
    at("enter").hidden = true;
  });
});
at("marks").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!at("save").disabled) void attempt(() => save(false));
});
at("cannot").addEventListener("click", () => void attempt(() => save(true)));
at("step").addEventListener("input", () => move(Number(at("step").value)));
at("play").addEventListener("click", () => {
  playing = !playing;
  refresh();
});
document.addEventListener("keydown", (event) => {
  if (!shown || ["INPUT", "TEXTAREA", "SELECT"].includes(event.target.tagName)) {
    if (event.target.type !== "checkbox" && event.target.type !== "range") return;
  }
  if (!shown || event.ctrlKey || event.metaKey || event.altKey) return;
  const digit = Number(event.key) - 1;
  if (digit >= 0 && digit < shown.criteria.length) {
    const { name } = shown.criteria[digit];
    set(name, !marks[name]);
  } else if (event.key === " ") {
    playing = !playing;
    refresh();
  } else if (event.key === "ArrowLeft") move(step - 1);
  else if (event.key === "ArrowRight") move(step + 1);
  else if (event.key === "i") at("is_inconsistent").checked = !at("is_inconsistent").checked;
  else if (event.key === "c") at("cannot").click();
  else if (event.key === "Enter") at("save").click();
  else return;
  event.preventDefault();
});
requestAnimationFrame(tick);
