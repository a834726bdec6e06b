// The page of a training: asks for its curves and its newest preview every few seconds.
"use strict";
(() => {
  const at = (id) => document.getElementById(id);
  const PERIOD = 5000, HEIGHT = 180;
  const NAMES = { loss: "loss", gradient_norm: "norm of the gradient", learning_rate: "learning rate", seconds: "seconds a step" };
  const LOGARITHMIC = new Set(["loss", "gradient_norm"]);
  const plots = new Map();
  let known = {}, previews = [], newest = true;

  async function ask(name, body) {
    const answer = await fetch(name, body === undefined ? {} : { method: "POST", body });
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  }

  // --- curves

  function drawn(name, width) {
    const ink = getComputedStyle(document.body).getPropertyValue("--faint"), line = getComputedStyle(document.body).getPropertyValue("--line");
    const axis = { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 } };
    const logarithmic = at("log").checked && LOGARITHMIC.has(name);
    return new uPlot(
      {
        title: NAMES[name] || name, width, height: HEIGHT,
        scales: { x: { time: false }, y: { distr: logarithmic ? 3 : 1 } },
        axes: [axis, { ...axis, size: 64 }],
        series: [{ label: "step" }, { label: NAMES[name] || name, stroke: getComputedStyle(document.body).getPropertyValue("--chosen"), width: 1.5, points: { show: false } }],
      },
      [known.step, known[name]],
      at("curves"),
    );
  }

  function width() {
    return Math.max(240, Math.floor(at("curves").clientWidth));
  }

  function show(curves) {
    known = curves;
    const names = Object.keys(curves).filter((name) => name !== "step");
    if (names.length && !plots.size) at("curves").replaceChildren();
    for (const name of names) {
      if (plots.has(name)) plots.get(name).setData([curves.step, curves[name]]);
      else plots.set(name, drawn(name, width()));
    }
  }

  function redraw() {
    for (const plot of plots.values()) plot.destroy();
    plots.clear();
    show(known);
  }

  at("log").addEventListener("change", redraw);
  addEventListener("resize", () => plots.forEach((plot) => plot.setSize({ width: width(), height: HEIGHT })));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  // --- previews

  async function turnTo(place) {
    const step = previews[place];
    const blob = await (await ask("preview", String(step))).blob();
    const reader = new FileReader();
    reader.onload = () => {
      at("preview").src = reader.result;
      at("preview").alt = `The input, and a sample of the network alone after ${step} steps.`;
      at("preview").hidden = at("steps").hidden = false;
      at("shown").value = step.toLocaleString("en");
      at("note").textContent = "The input, and a sample of the network alone, always of the same noise.";
    };
    reader.readAsDataURL(blob);
  }

  at("step").addEventListener("input", () => {
    newest = at("step").valueAsNumber === previews.length - 1;
    turnTo(at("step").valueAsNumber).catch(trouble);
  });

  async function list(steps) {
    if (steps.length === previews.length) return;
    previews = steps;
    at("step").max = Math.max(0, steps.length - 1);
    if (newest && steps.length) {
      at("step").value = steps.length - 1;
      await turnTo(steps.length - 1);
    }
  }

  // --- every few seconds

  function trouble(fault) {
    at("done").textContent = fault instanceof TypeError ? "flx does not answer; is it still running?" : fault.message;
  }

  async function look() {
    try {
      const data = await (await ask("data")).json();
      const done = data.curves.step ? data.curves.step[data.curves.step.length - 1] : 0;
      at("progress").value = done / data.steps;
      at("done").textContent = `${done.toLocaleString("en")} of ${data.steps.toLocaleString("en")} steps`;
      show(data.curves);
      await list(data.previews);
      if (data.trouble) at("note").textContent = `No newer preview: ${data.trouble}`;
    } catch (fault) {
      trouble(fault);
    }
    setTimeout(look, PERIOD);
  }

  look();
})();
