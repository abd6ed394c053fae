// Puts charts in the place of the static pictures; without this script, and in print, these stay.
"use strict";
(() => {
  const coarse = matchMedia("(pointer: coarse)").matches; // a finger's drag is for scrolling
  const config = { displayModeBar: false, responsive: true, doubleClick: false, showTips: false };
  const keys = {
    ArrowLeft: (plot) => pan(plot, "xaxis", -0.1), ArrowRight: (plot) => pan(plot, "xaxis", 0.1),
    ArrowDown: (plot) => pan(plot, "yaxis", -0.1), ArrowUp: (plot) => pan(plot, "yaxis", 0.1),
    "+": (plot) => zoom(plot, 0.5), "-": (plot) => zoom(plot, 2), 0: reset,
  };

  function pan(plot, axis, share) {
    const [low, high] = plot.layout[axis].range;
    const step = share * (high - low);
    return Plotly.relayout(plot, { [`${axis}.range`]: [low + step, high + step] });
  }

  function zoom(plot, factor) {
    const [low, high] = plot.layout.xaxis.range;
    const middle = (low + high) / 2, half = (factor * (high - low)) / 2;
    return Plotly.relayout(plot, { "xaxis.range": [middle - half, middle + half] });
  }

  // The ranges that the page gave hold for the kind of axis that it gave; otherwise all there is.
  function home(plot, types = {}) {
    const update = {};
    for (const [name, given] of Object.entries(plot.given)) {
      const type = types[`${name}.type`] ?? plot.layout[name].type;
      if (given.range && given.type === type) update[`${name}.range`] = [...given.range];
      else update[`${name}.autorange`] = true;
    }
    return update;
  }

  function reset(plot) {
    return Plotly.relayout(plot, home(plot));
  }

  function press(button, control, plots) {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", on);
    control.updates.forEach((update, i) => {
      const { restyle, relayout, traces } = update[on ? "on" : "off"], plot = plots[i];
      Plotly.update(plot, restyle, { ...relayout, ...home(plot, relayout) }, traces);
    });
  }

  async function build(figure) {
    const spec = JSON.parse(figure.querySelector("script").textContent);
    const plots = [...figure.querySelectorAll(".plot")];
    try {
      for (const [i, plot] of plots.entries()) await draw(plot, spec.plots[i]);
    } catch (error) {
      figure.classList.remove("live");
      throw error;
    }
    const [toggles, zooms] = ["[aria-pressed]", "[data-zoom]"].map((each) => figure.querySelectorAll(each));
    toggles.forEach((button, i) => button.addEventListener("click", () => press(button, spec.controls[i], plots)));
    zooms.forEach((button) =>
      button.addEventListener("click", () => plots.forEach((plot) => keys[button.dataset.zoom](plot))));
  }

  async function draw(plot, { data, layout }) {
    const axes = Object.entries(layout).filter(([name]) => /^[xy]axis/.test(name));
    plot.given = Object.fromEntries(axes.map(([name, { type, range }]) => [name, { type, range: range && [...range] }]));
    await Plotly.newPlot(plot, data, { ...layout, dragmode: coarse ? false : "zoom" }, config);
    plot.on("plotly_doubleclick", () => reset(plot));
    plot.addEventListener("keydown", (event) => {
      const act = keys[event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act(plot);
    });
  }

  // A chart is drawn when it comes near, so that a page of many opens as soon as one of few. Those that are near at the
  // start are drawn at once, since a browser that only takes a picture may never call the observer.
  const near = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      near.unobserve(target);
      build(target);
    }
  }, { rootMargin: "50%" });
  for (const figure of document.querySelectorAll("figure.chart")) {
    figure.classList.add("live");
    if (figure.getBoundingClientRect().top < 1.5 * innerHeight) build(figure);
    else near.observe(figure);
  }
})();
