// The page of a controller. look(t, x, u, V), step(t, x, after, cost, u, V) and about(x, goal, end, worst) are its functions.
const facts = JSON.parse(document.getElementById("facts").textContent);
const [BLUE, ORANGE, GREEN, VERMILION, GREY] = ["#0072B2", "#E69F00", "#009E73", "#D55E00", "#777777"];
const CYCLE = [BLUE, VERMILION, "#CC79A7", ORANGE, "#56B4E9", "#222222"];
const TIME = -1; // as an axis
const n = facts.states.length, m = facts.controls.length, T = facts.steps * facts.dt;
const phone = matchMedia("(max-width: 600px)"); // a window as narrow as that of one
const chosen = { t: 0, axes: facts.axes, layer: "V", x: facts.start.slice(), loops: [], count: 0 };
const element = (id) => document.getElementById(id);
const short = (number) => String(Number(number.toPrecision(4)));

// The controller's functions, with results of their own.
function looked(t, x) {
  const u = new Float64Array(m), V = new Float64Array(1);
  look([t], x, u, V);
  return { u, V: V[0] };
}
function stepped(t, x) {
  const after = new Float64Array(n), cost = new Float64Array(1), u = new Float64Array(m), V = new Float64Array(1);
  step([t], x, after, cost, u, V);
  return { after, cost: cost[0], u, V: V[0] };
}
function told(x) {
  const goal = new Float64Array(n), end = new Float64Array(1), worst = new Float64Array(1);
  about(x, goal, end, worst);
  return { goal, end: end[0], worst: worst[0] };
}
// Whether a control is at a limit.
function limited(u) {
  return facts.controls.some(({ lower, upper }, k) => {
    const room = 1e-6 * (lower !== null && upper !== null ? upper - lower : 1 + Math.abs(upper ?? lower ?? 0));
    return (upper !== null && u[k] >= upper - room) || (lower !== null && u[k] <= lower + room);
  });
}
// The parameters of a family, as indices of states, and one of them in the numbers of its range in the config.
const parameters = [...facts.states.keys()].filter((i) => facts.states[i].parameter !== null);
const asGiven = (i, value) => short(facts.states[i].logarithmic ? 10 ** value : value);
const hasLimits = facts.controls.some(({ lower, upper }) => lower !== null || upper !== null);

// Whether state k lies between its bounds in X0, and whether all do.
function between(x, k) {
  const { lower, upper } = facts.initialStates, room = 1e-9 * (1 + Math.abs(lower[k]) + Math.abs(upper[k]));
  return x[k] >= lower[k] - room && x[k] <= upper[k] + room;
}
const inX0 = (x) => facts.states.every((_, k) => between(x, k));

// The closed loop from x0 at t = 0, until T or until it leaves the finite numbers.
function closedLoop(x0) {
  const loop = { x: [], u: [], V: [], paid: [0], worst: -Infinity, atLimit: 0, outside: !inX0(x0) };
  let x = Float64Array.from(x0);
  for (let k = 0; k <= facts.steps; k++) {
    const last = k === facts.steps, { u, V, after, cost } = last ? looked(T, x) : stepped(k * facts.dt, x);
    loop.x.push(x);
    loop.V.push(V);
    if (facts.constraints.length) loop.worst = Math.max(loop.worst, told(x).worst);
    if (last) break;
    loop.u.push(u);
    loop.atLimit += limited(u) / facts.steps;
    if (!after.every(Number.isFinite)) break;
    loop.paid.push(loop.paid[k] + cost);
    x = after;
  }
  const whole = loop.x.length === facts.steps + 1;
  loop.cost = whole ? loop.paid[facts.steps] + told(x).end : NaN;
  loop.toGo = loop.paid.map((paid) => loop.cost - paid);
  loop.t = loop.x.map((_, k) => k * facts.dt);
  return loop;
}
// A closed loop with the name and colour that its number has.
function numbered(loop, number) {
  const name = `closed loop ${number}${loop.outside ? ", from outside X₀" : ""}`;
  return { ...loop, number, name, color: CYCLE[(number - 1) % CYCLE.length] };
}

// The plane: the slice of the two axes through the other states.
const axis = (i) => (i === TIME ? { label: "time (s)", low: 0, high: T } : facts.states[i]);
function at(a, b) {
  const x = Float64Array.from(chosen.x);
  let t = chosen.t;
  [a, b].forEach((value, k) => {
    if (chosen.axes[k] === TIME) t = value;
    else x[chosen.axes[k]] = value;
  });
  return { t, x };
}
// As many points along an axis as can be drawn while a slider moves, once the browser has compiled the functions.
const points = (() => {
  const { x } = facts.checks, spent = (count) => {
    const begun = performance.now();
    for (let k = 0; k < count; k++) looked(0, x[k % x.length]);
    return performance.now() - begun;
  };
  for (let k = 0, warm = 0; k < 50 && warm < 200; k++) warm += spent(20);
  return Math.round(Math.min(81, Math.max(41, Math.sqrt((200 * 50) / spent(50)))));
})();

// What the plane shows, one row after another: after each row it yields, so that a slider can be answered in between.
function* rowsOfGrid() {
  const [across, up] = chosen.axes.map(axis).map(({ low, high }) =>
    Array.from({ length: points }, (_, k) => low + ((high - low) * k) / (points - 1)));
  const layers = { V: [], u: facts.controls.map(() => []), limited: [], worst: [], funnel: [] };
  for (const b of up) {
    const row = across.map((a) => {
      const { t, x } = at(a, b);
      return { t, x, ...looked(t, x) };
    });
    layers.V.push(row.map(({ V }) => V));
    layers.u.forEach((rows, k) => rows.push(row.map(({ u }) => u[k])));
    if (hasLimits) layers.limited.push(row.map(({ u }) => +limited(u)));
    if (facts.constraints.length) layers.worst.push(row.map(({ x }) => told(x).worst));
    if (facts.funnel) layers.funnel.push(row.map(depth));
    yield;
  }
  return { across, up, ...layers };
}
function grid() {
  const rows = rowsOfGrid();
  for (;;) {
    const { done, value } = rows.next();
    if (done) return value;
  }
}
// rho + delta t - V(t, x) within the set D of the funnel; null outside of it.
function depth({ t, x, V }) {
  const { lower, upper, rho, delta } = facts.funnel;
  const inside = lower.every((low, i) => low === upper[i] || (x[i] >= low && x[i] <= upper[i]));
  return inside ? rho + delta * t - V : null;
}
// Where a layer is above a height, as a filled contour with an entry in the legend; what is below is painted first.
function region(name, layer, height, color, fill) {
  return {
    type: "contour", name, ...layer, contours: { start: height, end: height, size: 1, coloring: "fill" },
    colorscale: [[0, "rgba(0,0,0,0)"], [1, fill]], line: { color, width: 2.5 }, showscale: false, showlegend: true,
    hoverinfo: "skip",
  };
}
function layers({ across: x, up: y, V, u, limited, worst, funnel }) {
  const k = chosen.layer === "V" ? null : Number(chosen.layer), place = { x, y };
  const [h, v] = chosen.axes.map((i) => axis(i).label);
  const what = k === null ? "V" : facts.controls[k].label, text = k === null ? "V (cost)" : what;
  const colorbar = phone.matches // above the plane, which is then as wide as the window
    ? { title: { text, side: "top" }, orientation: "h", thickness: 14, y: 1, yanchor: "bottom" }
    : { title: { text, side: "right" } };
  const colour = { z: k === null ? V : u[k], colorscale: k === null ? "Cividis" : "RdBu", colorbar };
  const found = [
    { type: "heatmap", ...place, ...colour, zsmooth: "best", opacity: 0.8,
      hovertemplate: `${h}: %{x:.4g}<br>${v}: %{y:.4g}<br>${what}: %{z:.4g}<extra></extra>` },
    { type: "contour", ...place, z: V, name: "level sets of V", ncontours: 12, showscale: false, showlegend: true,
      colorscale: [[0, "#333333"], [1, "#333333"]], hoverinfo: "skip", line: { width: 0.8 },
      contours: { coloring: "lines", showlabels: true, labelfont: { size: 10, color: "#222" } } },
  ];
  if (hasLimits && limited.flat().some((l) => l !== limited[0][0]))
    found.push(region("a control at its limit", { ...place, z: limited }, 0.5, ORANGE, "rgba(230,159,0,0.30)"));
  if (facts.constraints.length)
    found.push(region("forbidden", { ...place, z: worst }, 0, "#000000", "rgba(0,0,0,0.55)"));
  if (facts.funnel)
    found.push(region("proved funnel", { ...place, z: funnel }, 0, GREEN, "rgba(0,158,115,0.25)"));
  return found;
}
// X0, the goal and closed loops in the plane.
function marks() {
  const [i, j] = chosen.axes, { lower, upper } = facts.initialStates, found = [];
  const goal = told(chosen.x).goal;
  const through = facts.states.every((_, k) => [i, j].includes(k) || between(chosen.x, k));
  const ends = (k) => (k === TIME ? [0, 0] : [lower[k], upper[k]]);
  const [[left, right], [bottom, top]] = [ends(i), ends(j)];
  if (through && i !== TIME) { // the map pales outside of X0
    const [across, up] = [axis(i), axis(j)];
    found.push({
      x: [across.low, across.high, across.high, across.low, across.low, left, left, right, right, left, across.low],
      y: [up.low, up.low, up.high, up.high, up.low, bottom, top, top, bottom, bottom, up.low],
      mode: "lines", line: { width: 0 }, fill: "toself", fillcolor: "rgba(255,255,255,0.5)", hoverinfo: "skip",
      showlegend: false,
    });
  }
  found.push({
    x: [left, right, right, left, left], y: [bottom, bottom, top, top, bottom], mode: "lines", hoverinfo: "skip",
    name: through ? "X₀" : "X₀, projected", line: { color: "#000000", width: 2, dash: through ? "solid" : "dot" },
  });
  if (facts.hasGoal) found.push({
    x: i === TIME ? [0, T] : [goal[i]], y: Array(i === TIME ? 2 : 1).fill(goal[j]), name: "goal", hoverinfo: "skip",
    mode: i === TIME ? "lines" : "markers", line: { color: VERMILION, dash: "dot" },
    marker: { symbol: "star", size: 13, color: VERMILION, line: { color: "#fff", width: 1 } },
  });
  for (const loop of chosen.loops) {
    const along = (k) => (k === TIME ? loop.t : loop.x.map((x) => x[k]));
    const node = Math.min(loop.x.length - 1, Math.round(chosen.t / facts.dt)), [a, b] = [along(i), along(j)];
    const outline = { color: "#ffffff", width: 4.5 };
    found.push({ x: a, y: b, mode: "lines", line: outline, showlegend: false, hoverinfo: "skip" });
    const line = { color: loop.color, width: 2.5, dash: loop.outside ? "dash" : "solid" };
    found.push({ x: a, y: b, mode: "lines", name: loop.name, line, hoverinfo: "skip" });
    found.push({
      x: [a[node]], y: [b[node]], mode: "markers", showlegend: false, hoverinfo: "skip",
      marker: { size: 11, color: loop.color, line: { color: "#ffffff", width: 2 } },
    });
  }
  return found;
}
const CONFIG = { displaylogo: false };
function drawPlane(shown = grid()) {
  drawing++; // what is drawn in the background is out of date
  const [across, up] = chosen.axes.map(axis), line = { color: "#ffffff", width: 2, dash: "dash" };
  const clock = { type: "line", x0: chosen.t, x1: chosen.t, yref: "paper", y0: 0, y1: 1, line };
  Plotly.react("plane", [...layers(shown), ...marks()], {
    height: 600, margin: { l: phone.matches ? 52 : 70, r: 10, t: 30, b: 110 }, hovermode: "closest", dragmode: "zoom",
    uirevision: chosen.axes.join(), shapes: chosen.axes.includes(TIME) ? [clock] : [],
    xaxis: { title: { text: across.label }, range: [across.low, across.high], zeroline: false },
    yaxis: { title: { text: up.label }, range: [up.low, up.high], zeroline: false },
    legend: { orientation: "h", x: 0, y: -0.11, yanchor: "top" },
  }, CONFIG);
}

// The plane drawn between other events, unless another drawing of it begins.
let drawing = 0;
function drawPlaneInBackground() {
  const own = ++drawing, rows = rowsOfGrid();
  const proceed = () => {
    if (own !== drawing) return;
    const { done, value } = rows.next();
    if (done) drawPlane(value);
    else setTimeout(proceed);
  };
  proceed();
}

// Courses: states, controls with their limits, and V beside the cost to go, over time.
const panels = [
  ...facts.states.flatMap((s, i) => (s.parameter !== null ? [] : [{ label: s.label, of: (loop) => loop.x.map((x) => x[i]) }])),
  ...facts.controls.map((c, k) => ({ label: c.label, of: (loop) => loop.u.map((u) => u[k]), limits: [c.lower, c.upper] })),
  { label: "cost", of: (loop) => loop.V, beside: (loop) => loop.toGo },
];
function drawCourses() {
  const traces = [], shapes = [], layout = {};
  const columns = phone.matches || panels.length < 6 ? 1 : panels.length < 13 ? 2 : 3;
  const rows = Math.ceil(panels.length / columns);
  panels.forEach((panel, p) => {
    const id = p ? p + 1 : "", names = { xaxis: `x${id}`, yaxis: `y${id}` }, column = Math.floor(p / rows), row = p % rows;
    const gap = columns > 1 ? 0.1 : 0, width = (1 - gap * (columns - 1)) / columns, height = 1 / rows;
    const left = column * (width + gap), top = 1 - row * height, lowest = row === rows - 1 || p === panels.length - 1;
    layout[`xaxis${id}`] = {
      domain: [left, left + width], anchor: names.yaxis, range: [0, T], matches: p ? "x" : undefined,
      showticklabels: lowest, title: lowest ? { text: "time (s)", standoff: 4 } : undefined, zeroline: false,
    };
    layout[`yaxis${id}`] = {
      domain: [top - height * 0.86, top], anchor: names.xaxis, nticks: 4, zeroline: false,
      title: { text: panel.label.replace(" (", "<br>("), font: { size: 11 }, standoff: 4 },
    };
    const draw = (loop, y, name, dash, legend) => traces.push({
      ...names, x: loop.t, y, mode: "lines", name, showlegend: legend, line: { color: loop.color, width: 1.8, dash },
      hovertemplate: "%{y:.4g} at %{x:.3g} s<extra></extra>",
    });
    for (const loop of chosen.loops) {
      draw(loop, panel.of(loop), loop.name, "solid", p === 0);
      if (panel.beside) draw(loop, panel.beside(loop), loop.name, "dash", false);
    }
    if (panel.beside) for (const [name, dash] of [["V(t, x)", "solid"], ["cost to go", "dash"]])
      traces.push({ ...names, x: [null], y: [null], mode: "lines", name, line: { color: GREY, dash } });
    for (const limit of panel.limits ?? []) if (limit !== null)
      traces.push({ ...names, x: [0, T], y: [limit, limit], mode: "lines", hoverinfo: "skip", name: "limit",
                    legendgroup: "limit", showlegend: !traces.some((t) => t.name === "limit"),
                    line: { color: ORANGE, width: 1.4, dash: "dot" } });
    shapes.push({ type: "line", xref: names.xaxis, yref: `${names.yaxis} domain`, x0: chosen.t, x1: chosen.t, y0: 0, y1: 1,
                  line: { color: "#999", width: 1 } });
  });
  const hint = { text: "a click in the plane<br>starts a closed loop", showarrow: false, font: { size: 12 },
                 xref: "x domain", yref: "y domain", x: 0.5, y: 0.5 };
  Plotly.react("courses", traces, {
    ...layout, shapes, annotations: chosen.loops.length ? [] : [hint], height: Math.max(560, 125 * rows + 110), margin: { l: 65, r: 10, t: 30, b: 60 },
    legend: { orientation: "h", x: 0, y: -70 / (125 * rows), yanchor: "top" },
  }, CONFIG);
}
// A line while the last closed loop starts outside X0, where only a proved funnel says something.
function warn(loop) {
  const held = loop && facts.funnel && depth({ t: 0, x: loop.x[0], V: loop.V[0] }) > 0;
  element("outside").hidden = !loop?.outside;
  element("outside").textContent = "This start lies outside the initial states X₀ that the controller was trained on: " +
    (held ? "only the proved funnel holds it." : "the training says nothing of it.");
}
function tell() {
  const head = ["", "J(x₀)", "V(0, x₀)", "time at a limit", "constraints", ...parameters.map((i) => facts.states[i].parameter)];
  const shown = head.map((_, c) => (c === 3 ? hasLimits : c === 4 ? facts.constraints.length > 0 : true));
  const lines = chosen.loops.map((loop) => [
    loop.name, Number.isFinite(loop.cost) ? short(loop.cost) : "diverges", short(loop.V[0]),
    `${(100 * loop.atLimit).toFixed(0)} %`, loop.worst > 0 ? "violated" : "kept",
    ...parameters.map((i) => asGiven(i, loop.x[0][i])),
  ]);
  warn(chosen.loops.at(-1));
  element("loops").replaceChildren(...(lines.length ? [head, ...lines] : []).map((cells, r) => {
    const row = document.createElement("tr");
    row.append(...cells.filter((_, c) => shown[c]).map((text) => {
      const cell = document.createElement(r ? "td" : "th");
      cell.textContent = text;
      return cell;
    }));
    return row;
  }));
}

// Where X0 is too thin to be hit by a click, what is close to it is on it.
function onThin(value, k) {
  const { low, high } = axis(k), middle = (facts.initialStates.lower[k] + facts.initialStates.upper[k]) / 2;
  const thin = facts.initialStates.upper[k] - facts.initialStates.lower[k] < 0.01 * (high - low);
  return thin && Math.abs(value - middle) < 0.02 * (high - low) ? middle : value;
}

// What the user sets.
function start(x0) {
  chosen.loops = [...chosen.loops, numbered(closedLoop(x0), ++chosen.count)].slice(-CYCLE.length);
  drawPlane();
  drawCourses();
  tell();
}
// The last closed loop anew from its start, with the parameters of the sliders; the first one if there is none.
function follow() {
  const last = chosen.loops.pop(), x0 = Float64Array.from(last?.x[0] ?? facts.first);
  for (const i of parameters) x0[i] = chosen.x[i];
  chosen.loops.push(numbered(closedLoop(x0), last?.number ?? ++chosen.count));
  drawCourses();
  tell();
}
// Everything anew, as the first time: a plot keeps the margins that its legend once asked for at another width.
function drawAnew() {
  Plotly.purge("plane");
  Plotly.purge("courses");
  drawPlane();
  drawCourses();
  element("plane").on("plotly_click", ({ points: [point], event }) => {
    const box = document.querySelector("#plane .nsewdrag").getBoundingClientRect();
    const { x } = at(point.xaxis.p2d(event.clientX - box.left), point.yaxis.p2d(event.clientY - box.top));
    for (const k of chosen.axes) if (k !== TIME) x[k] = onThin(x[k], k);
    start(x);
  });
}
function moveTo(t) {
  chosen.t = t;
  element("clock").textContent = `${short(t)} s of ${short(T)} s`;
  drawPlane();
  Plotly.relayout("courses", Object.fromEntries(panels.flatMap((_, p) => [[`shapes[${p}].x0`, t], [`shapes[${p}].x1`, t]])));
}
function option(value, text) {
  const found = document.createElement("option");
  [found.value, found.textContent] = [value, text];
  return found;
}
function offerAxes() {
  const names = facts.states.map(({ label }, i) => [i, label]);
  element("across").replaceChildren(...[[TIME, "time (s)"], ...names].map((each) => option(...each)));
  element("up").replaceChildren(...names.map((each) => option(...each)));
  [element("across").value, element("up").value] = chosen.axes;
}
// A function that acts once for all calls within some milliseconds, as a slider tells more often than plots can be drawn.
function paced(milliseconds, act) {
  let waiting = false;
  return () => {
    if (!waiting) setTimeout(() => { waiting = false; act(); }, milliseconds);
    waiting = true;
  };
}
// A slider for each parameter of a family: the response follows at once, and the plane when the slider rests.
function offerParameters() {
  const redraw = resting(150, drawPlaneInBackground), answer = paced(0, follow);
  element("parameters").replaceChildren(...parameters.map((i) => {
    const { parameter, low, high } = facts.states[i];
    const label = document.createElement("label"), input = document.createElement("input"), shown = document.createElement("span");
    Object.assign(input, { type: "range", min: low, max: high, step: "any", value: chosen.x[i], id: `parameter${i}` });
    shown.textContent = asGiven(i, chosen.x[i]);
    input.addEventListener("input", () => {
      chosen.x[i] = input.valueAsNumber;
      shown.textContent = asGiven(i, chosen.x[i]);
      answer();
      redraw();
    });
    label.append(`${parameter} `, input, " ", shown);
    return label;
  }));
  element("follow").hidden = element("keep").hidden = !parameters.length;
  if (parameters.length) for (let k = 0; k < 10; k++) closedLoop(facts.first); // the browser compiles what a slider needs
}
// A function that acts once it has not been called for some milliseconds.
function resting(milliseconds, act) {
  let timer = 0;
  return () => {
    clearTimeout(timer);
    timer = setTimeout(act, milliseconds);
  };
}
function offerOthers() {
  const fields = facts.states.flatMap((state, i) => {
    if (chosen.axes.includes(i) || parameters.includes(i)) return [];
    const label = document.createElement("label"), input = document.createElement("input");
    Object.assign(input, { type: "number", step: "any", value: short(chosen.x[i]), id: `state${i}` });
    input.addEventListener("change", () => {
      if (Number.isFinite(input.valueAsNumber)) chosen.x[i] = input.valueAsNumber;
      drawPlane();
    });
    label.append(`${state.name} `, input, ` ${state.unit}`);
    return [label];
  });
  const back = document.createElement("button");
  back.textContent = `others at the ${facts.hasGoal ? "goal" : "centre of X₀"}`;
  back.addEventListener("click", () => {
    chosen.x = facts.start.map((value, i) => (parameters.includes(i) ? chosen.x[i] : value));
    offerOthers();
    drawPlane();
  });
  element("others").replaceChildren(...fields, ...(fields.length ? [back] : []));
}
function choose(place, i) {
  const axes = chosen.axes.slice();
  if (axes[1 - place] === i) axes[1 - place] = axes[place]; // the two change places
  axes[place] = i;
  if (axes[1] === TIME) axes[1] = [...facts.states.keys()].find((k) => k !== i);
  chosen.axes = axes;
  offerAxes();
  offerOthers();
  drawPlane();
}
// The largest difference from the controller in Python, relative to the largest number of its kind.
function difference() {
  const { t, x, u, V, after } = facts.checks;
  const largest = (numbers) => Math.max(...numbers.flat().map(Math.abs), 1e-300);
  const away = (one, other, size) => Math.max(...other.map((y, k) => Math.abs(one[k] - y) / size));
  const found = t.map((time, k) => {
    const here = looked(time, x[k]);
    return [away(here.u, u[k], largest(u)), away([here.V], [V[k]], largest(V)), away(stepped(time, x[k]).after, after[k], largest(after))];
  }).flat();
  return found.every(Number.isFinite) ? Math.max(...found) : Infinity;
}

element("title").textContent = facts.title;
element("task").textContent = facts.task;
element("layer").append(option("V", "V"), ...facts.controls.map(({ label }, k) => option(k, label)));
Object.assign(element("t"), { max: facts.steps, step: 1 });
const away = difference();
element("check").className = away < 1e-3 ? "note" : "wrong";
element("check").textContent = away < 1e-3
  ? `u, V and the closed loop are computed in this page; they differ from the controller by ${away.toExponential(1)} at ${facts.checks.t.length} states.`
  : `This page differs from the controller by ${away.toExponential(1)}: do not use it.`;
if (facts.funnel) {
  const { alpha, delta, rho } = facts.funnel;
  element("funnel").textContent = `Proved funnel: V(t, x) ≤ ρ + δt within its set, ρ = ${short(rho)}, δ = ${short(delta)}, ` +
    `α = ${short(alpha)}, as the file of the proof records; lyapnet certify check bounds its leaves anew.`;
}
offerAxes();
offerParameters();
offerOthers();
drawAnew();
moveTo(0);
element("t").addEventListener("input", paced(20, () => moveTo(Math.min(T, element("t").valueAsNumber * facts.dt))));
element("keep").addEventListener("click", () => { if (chosen.loops.length) start(chosen.loops.at(-1).x[0]); });
element("across").addEventListener("change", (event) => choose(0, Number(event.target.value)));
element("up").addEventListener("change", (event) => choose(1, Number(event.target.value)));
element("layer").addEventListener("change", (event) => { chosen.layer = event.target.value; drawPlane(); });
const watched = new ResizeObserver((changes) => changes.forEach(({ target }) => Plotly.Plots.resize(target)));
for (const id of ["plane", "courses"]) watched.observe(element(id));
phone.addEventListener("change", drawAnew);
element("clear").addEventListener("click", () => { chosen.loops = []; drawPlane(); drawCourses(); tell(); });
