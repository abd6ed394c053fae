// The page's clicks: uploads, the set-up form, and progress. Everything that is shown comes from the server as HTML.
"use strict";
(() => {
  const { root, largest, tooLarge, analysis, state } = document.body.dataset;
  const find = (id) => document.getElementById(id);
  const set = (id, text) => { if (find(id)) find(id).textContent = text; };
  const pollInterval = 200; // ms

  function show(error) {
    set("alert", error.message);
    set("status", "");
    if (error.message) find("alert").scrollIntoView({ block: "center" });
  }

  async function ask(address, body) {
    let response;
    try {
      response = await fetch(address, body === undefined ? {} : { method: "POST", body });
    } catch {
      throw new Error("fitact app does not answer; start it again, and open the address that it prints");
    }
    if (response.status === 413) throw new Error(tooLarge);
    if (!response.ok) throw new Error(await response.text());
    return response;
  }

  // One change after the other, so that an answer never overtakes a later one.
  let queue = Promise.resolve();
  function enqueue(task) {
    queue = queue.then(task).catch(show);
    return queue;
  }

  const isScene = (file) => file.name.toLowerCase().endsWith(".toml");

  async function upload(files, address) {
    set("alert", "");
    let place = analysis;
    for (const file of files.sort((a, b) => isScene(a) - isScene(b))) { // scenes last, into the analysis of the records
      if (file.size > Number(largest)) {
        throw new Error(`${file.name}: ${tooLarge}`); // the server would break the connection off
      }
      set("status", `Sending and reading ${file.name} …`);
      if (isScene(file) && place) {
        await ask(`${place}/scene`, file);
        continue;
      }
      const answer = await ask(`${place ? `${place}/files` : address}?name=${encodeURIComponent(file.name)}`, file);
      place = `${root}/analyses/${(await answer.json()).analysis}`;
    }
    location.assign(place);
  }

  for (const area of document.querySelectorAll(".drop")) {
    const start = (files) => enqueue(() => upload([...files], area.dataset.upload));
    area.querySelector("input").addEventListener("change", (event) => start(event.target.files));
    for (const kind of ["dragover", "dragleave", "drop"]) {
      document.addEventListener(kind, (event) => {
        event.preventDefault();
        area.classList.toggle("over", kind === "dragover");
        if (kind === "drop" && event.dataTransfer.files.length) start(event.dataTransfer.files);
      });
    }
  }

  function showErrors(errors) {
    for (const line of document.querySelectorAll("p.error")) {
      const name = line.id.replace("error-", ""), field = find(name);
      line.textContent = errors[name] ?? "";
      if (line.textContent) line.closest("details")?.setAttribute("open", "");
      if (field?.name) field.setAttribute("aria-invalid", name in errors);
    }
  }

  async function store() {
    const answer = await (await ask(`${analysis}/set-up`, new URLSearchParams(new FormData(find("set-up"))))).json();
    if (find("inspected").innerHTML !== answer.files) find("inspected").innerHTML = answer.files;
    set("command", answer.command);
    set("status", find("inspected").querySelector(".refusal") ? "A file is refused, see above."
      : find("inspected").querySelector(".warnings") ? "There are warnings, see above." : "");
    set("alert", "");
    showErrors(answer.errors);
    return Object.keys(answer.errors);
  }

  async function loadShipped(name) {
    find("scene").innerHTML = await (await ask(`${analysis}/scene?name=${encodeURIComponent(name)}`, "")).text();
    await store();
  }

  async function start() {
    const errors = await store();
    if (!errors.length) return act("start");
    const place = find(errors[0]) ?? find("error-scene");
    place.scrollIntoView({ block: "center" });
    place.focus();
  }

  async function act(action) {
    const answer = await (await ask(`${analysis}/actions/${action}`, "")).json();
    location.assign(`${root}/analyses/${answer.analysis}`);
  }

  find("set-up")?.addEventListener("change", (event) => {
    if (event.target.id === "shipped") enqueue(() => event.target.value && loadShipped(event.target.value));
    else enqueue(store);
  });
  find("set-up")?.addEventListener("submit", (event) => event.preventDefault());
  find("start")?.addEventListener("click", () => enqueue(start));
  document.addEventListener("click", (event) => {
    const action = event.target.dataset?.action;
    if (action) enqueue(() => act(action));
  });

  async function poll() {
    try {
      const now = await (await ask(`${analysis}/progress`)).json();
      set("alert", "");
      if (now.state !== state) return location.reload();
      if (find("messages").textContent !== now.messages.join("\n")) {
        set("messages", now.messages.join("\n"));
        set("last", now.messages.at(-1));
        find("messages").scrollTop = find("messages").scrollHeight;
      }
      if (now.percent !== null) Object.assign(find("bar"), { max: 100, value: now.percent });
    } catch (error) {
      show(error);
    }
    setTimeout(poll, pollInterval);
  }
  if (state === "running" || state === "stopping") poll();
})();
