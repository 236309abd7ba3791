"use strict";

// The data is JSON in the page; everything from it reaches the page as text or as numbers.
const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);
const FAR = 0; // a range that is no return
const STATES = {
  right: "located, right",
  wrong: "located, wrong",
  located: "located",
  unknownRight: "not known, though the best guess is right",
  unknownWrong: "not known, and the best guess is wrong",
  unknown: "not known",
  itself: "itself a reference, not judged",
  unusable: "unusable scan",
};
const COLOURS = {
  right: "--right", located: "--right", wrong: "--wrong", unknownRight: "--unknown",
  unknownWrong: "--unknown", unknown: "--unknown", unusable: "--unusable", itself: "--unusable",
};
const ORDERS = {
  worst: "worst first", log: "as in the log", slowest: "slowest first",
  sure: "surest first", unsure: "least sure first",
};

// What is shown now.
const state = {
  run: 0, order: "worst", filter: "all", list: [], at: 0, hypothesis: 0,
  atTruth: false, showReference: true, threshold: null,
  view: null, // of the map: {x, y, scale}, the centre in metres and pixels a metre
};

// Small helpers

function make(name, attributes, ...children) {
  const svg = ["svg", "path", "line", "rect", "circle", "text", "title"].includes(name);
  const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", name)
    : document.createElement(name);
  for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function number(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

function percent(share) {
  return share === null ? "–" : `${(100 * share).toFixed(1)} %`;
}

function milliseconds(seconds) {
  const value = 1000 * seconds;
  return value >= 100 ? value.toFixed(0) : value.toPrecision(2);
}

function degrees(radians) {
  return radians === null || radians === undefined ? "–" : `${(radians * 180 / Math.PI).toFixed(1)}°`;
}

function decoded(text, Type) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Type(bytes.buffer);
}

// End points of a scan in its own frame, [x, y, x, y, ...] in metres.
const pointsOf = new Map();
function scanPoints(index) {
  if (index === null || index === undefined) return new Float32Array(0);
  if (!pointsOf.has(index)) {
    const [sensor, text] = data.scans[index];
    const [first, step] = data.sensors[sensor];
    const ranges = decoded(text, Uint16Array);
    const points = [];
    ranges.forEach((range, i) => {
      if (range !== FAR) {
        points.push(range / 100 * Math.cos(first + i * step), range / 100 * Math.sin(first + i * step));
      }
    });
    pointsOf.set(index, Float32Array.from(points));
  }
  return pointsOf.get(index);
}

function placed(points, pose) {
  const c = Math.cos(pose[2]), s = Math.sin(pose[2]);
  const moved = new Float32Array(points.length);
  for (let i = 0; i < points.length; i += 2) {
    moved[i] = pose[0] + c * points[i] - s * points[i + 1];
    moved[i + 1] = pose[1] + s * points[i] + c * points[i + 1];
  }
  return moved;
}

const run = () => data.runs[state.run];
const map = () => run().map === null ? null : data.maps[run().map];
const query = () => run().queries[state.list[state.at]];

function walls(place) {
  if (!place.corners) {
    const cells = decoded(place.cells, Uint16Array);
    place.corners = new Float32Array(cells.length);
    for (let i = 0; i < cells.length; i += 2) {
      place.corners[i] = place.x + cells[i] * place.cell;
      place.corners[i + 1] = place.y + cells[i + 1] * place.cell;
    }
  }
  return place.corners;
}

// What became of a query, at the threshold that is chosen

function accepted(each) {
  if (!each.hypotheses.length) return false;
  return state.threshold === null ? each.accepted : each.hypotheses[0].p >= state.threshold;
}

function stateOf(each) {
  if (!each.hypotheses.length) return each.reason ? "unusable" : "unknown";
  if (each.isReference) return "itself";
  if (each.right === null) return accepted(each) ? "located" : "unknown";
  if (accepted(each)) return each.right ? "right" : "wrong";
  return each.right ? "unknownRight" : "unknownWrong";
}

function shownPose(each) {
  return each.truth || (each.hypotheses.length ? each.hypotheses[0].pose : null);
}

const KEYS = {
  worst: (each, n) => n, // the queries come worst first
  log: (each) => each.scan,
  slowest: (each) => -(each.seconds || 0),
  sure: (each) => -(each.hypotheses.length ? each.hypotheses[0].p : -1),
  unsure: (each) => (each.hypotheses.length ? each.hypotheses[0].p : 2),
};

function arrange(keep) {
  const kept = keep === undefined ? null : keep;
  const chosen = [];
  run().queries.forEach((each, n) => {
    const now = stateOf(each);
    if (state.filter === "all" || state.filter === now
        || (state.filter === "anyUnknown" && now.startsWith("unknown"))) chosen.push(n);
  });
  const key = KEYS[state.order];
  const keys = run().queries.map(key);
  state.list = chosen.sort((a, b) => keys[a] - keys[b] || a - b);
  state.at = Math.max(0, state.list.indexOf(kept));
  state.hypothesis = 0;
}

// Drawing on a canvas: a frame carries metres to pixels

function frameOf(canvas, view) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return {
    context, width, height, scale: view.scale, ratio,
    x: (metres) => width / 2 + (metres - view.x) * view.scale,
    y: (metres) => height / 2 - (metres - view.y) * view.scale,
  };
}

function fitting(canvas, low, high) {
  const width = Math.max(high[0] - low[0], 1), height = Math.max(high[1] - low[1], 1);
  return {
    x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2,
    scale: Math.min(canvas.clientWidth / width, canvas.clientHeight / height) * 0.94,
  };
}

function drawWalls(frame, place) {
  const corners = walls(place), size = Math.max(place.cell * frame.scale, 1);
  frame.context.fillStyle = colour("--wall");
  frame.context.globalAlpha = size > 1 ? 0.6 : 0.75;
  for (let i = 0; i < corners.length; i += 2) {
    const x = frame.x(corners[i]), y = frame.y(corners[i + 1]) - size;
    if (x > -size && y > -size && x < frame.width && y < frame.height) {
      frame.context.fillRect(x, y, size, size);
    }
  }
  frame.context.globalAlpha = 1;
}

function drawPoints(frame, points, fill, radius, square) {
  const { context } = frame;
  context.fillStyle = fill;
  for (let i = 0; i < points.length; i += 2) {
    const x = frame.x(points[i]), y = frame.y(points[i + 1]);
    if (square) {
      context.fillRect(x - radius, y - radius, 2 * radius, 2 * radius);
    } else {
      context.beginPath();
      context.arc(x, y, radius, 0, 7);
      context.fill();
    }
  }
}

function drawSensor(frame, pose, fill, size, hollow) {
  const { context } = frame;
  context.save();
  context.translate(frame.x(pose[0]), frame.y(pose[1]));
  context.rotate(-pose[2]);
  context.beginPath();
  context.moveTo(size, 0);
  context.lineTo(-0.7 * size, 0.7 * size);
  context.lineTo(-0.7 * size, -0.7 * size);
  context.closePath();
  context.lineWidth = hollow ? 2 : 1;
  context.strokeStyle = hollow ? fill : colour("--ink");
  if (!hollow) {
    context.fillStyle = fill;
    context.fill();
  }
  context.stroke();
  context.restore();
}

// A short line from where a reference was taken to where it looked.
function drawReference(frame, pose) {
  const { context } = frame, x = frame.x(pose[0]), y = frame.y(pose[1]);
  context.strokeStyle = colour("--soft");
  context.lineWidth = 1;
  context.beginPath();
  context.arc(x, y, 1.5, 0, 7);
  context.moveTo(x, y);
  context.lineTo(x + 6 * Math.cos(pose[2]), y - 6 * Math.sin(pose[2]));
  context.stroke();
}

function drawEllipse(frame, pose, spread, stroke) {
  const [xx, xy, yy] = spread;
  const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
  const { context } = frame;
  context.beginPath();
  context.ellipse(frame.x(pose[0]), frame.y(pose[1]), 2 * Math.sqrt(middle + half) * frame.scale,
    2 * Math.sqrt(Math.max(middle - half, 0)) * frame.scale, -Math.atan2(2 * xy, xx - yy) / 2, 0, 7);
  context.strokeStyle = stroke;
  context.lineWidth = 1.5;
  context.stroke();
}

function drawRuler(frame) {
  const { context } = frame;
  const length = [200, 100, 50, 20, 10, 5, 2, 1, 0.5].find((n) => n * frame.scale < 0.3 * frame.width) || 0.2;
  const y = frame.height - 14;
  context.strokeStyle = context.fillStyle = colour("--ink");
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(12, y);
  context.lineTo(12 + length * frame.scale, y);
  context.stroke();
  context.font = "12px system-ui, sans-serif";
  context.fillText(`${length} m`, 12, y - 5);
}

// The map

function mapView() {
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  const take = (x, y) => {
    low[0] = Math.min(low[0], x); low[1] = Math.min(low[1], y);
    high[0] = Math.max(high[0], x); high[1] = Math.max(high[1], y);
  };
  if (map()) {
    take(map().bounds[0], map().bounds[2]);
    take(map().bounds[1], map().bounds[3]);
  }
  for (const each of run().queries) {
    const pose = shownPose(each);
    if (pose) take(pose[0], pose[1]);
  }
  return low[0] > high[0] ? null : fitting(element("map"), low, high);
}

function drawMark(frame, pose, kind, size) {
  const { context } = frame, x = frame.x(pose[0]), y = frame.y(pose[1]);
  context.strokeStyle = context.fillStyle = colour(COLOURS[kind]);
  context.lineWidth = 1.4;
  context.beginPath();
  if (kind === "wrong") {
    context.lineWidth = 2.4;
    context.moveTo(x - size, y - size); context.lineTo(x + size, y + size);
    context.moveTo(x - size, y + size); context.lineTo(x + size, y - size);
    context.stroke();
  } else if (kind === "right" || kind === "located") {
    context.arc(x, y, size * 0.8, 0, 7);
    context.fill();
  } else {
    context.arc(x, y, size * 0.8, 0, 7);
    context.stroke();
  }
}

function drawMap() {
  const canvas = element("map");
  if (!state.view) state.view = mapView();
  if (!state.view) {
    element("map-panel").hidden = true;
    return;
  }
  element("map-panel").hidden = false;
  const frame = frameOf(canvas, state.view), place = map();
  if (place) {
    drawWalls(frame, place);
    for (const pose of place.references) drawReference(frame, pose);
  }
  // What matters most is drawn last.
  const layer = (kind) => (kind === "wrong" ? 2 : kind === "itself" ? 0 : 1);
  for (const now of [0, 1, 2]) {
    for (const each of run().queries) {
      const kind = stateOf(each), pose = shownPose(each);
      if (!pose || layer(kind) !== now) continue;
      if (kind === "wrong" && each.truth) {
        frame.context.globalAlpha = 0.5;
        frame.context.strokeStyle = colour("--wrong");
        frame.context.lineWidth = 1;
        frame.context.beginPath();
        frame.context.moveTo(frame.x(pose[0]), frame.y(pose[1]));
        const best = each.hypotheses[0].pose;
        frame.context.lineTo(frame.x(best[0]), frame.y(best[1]));
        frame.context.stroke();
        frame.context.globalAlpha = 1;
      }
      drawMark(frame, pose, kind, 5);
    }
  }
  const chosen = query();
  if (chosen) {
    const hypothesis = chosen.hypotheses[state.hypothesis];
    if (hypothesis && hypothesis.pose) {
      const points = placed(scanPoints(chosen.points), hypothesis.pose);
      drawPoints(frame, points, colour("--right"), 1.2);
      drawSensor(frame, hypothesis.pose, colour("--reference"), 10);
    }
    if (chosen.truth) drawSensor(frame, chosen.truth, colour("--truth"), 13, true);
  }
  drawRuler(frame);
}

function nearestQuery(x, y) {
  let best = null, distance = 12;
  state.list.forEach((n, at) => {
    const pose = shownPose(run().queries[n]);
    if (!pose) return;
    const canvas = element("map"), view = state.view;
    const dx = canvas.clientWidth / 2 + (pose[0] - view.x) * view.scale - x;
    const dy = canvas.clientHeight / 2 - (pose[1] - view.y) * view.scale - y;
    if (Math.hypot(dx, dy) < distance) {
      distance = Math.hypot(dx, dy);
      best = at;
    }
  });
  return best;
}

function listenToMap() {
  const canvas = element("map");
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    drag = { x: event.offsetX, y: event.offsetY, view: { ...state.view }, moved: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!drag) return;
    const dx = event.offsetX - drag.x, dy = event.offsetY - drag.y;
    if (Math.hypot(dx, dy) > 3) drag.moved = true;
    if (drag.moved) {
      state.view.x = drag.view.x - dx / drag.view.scale;
      state.view.y = drag.view.y + dy / drag.view.scale;
      drawMap();
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    if (drag && !drag.moved) {
      const at = nearestQuery(event.offsetX, event.offsetY);
      if (at !== null) choose(at);
    }
    drag = null;
  });
  canvas.addEventListener("pointercancel", () => { drag = null; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const factor = Math.exp(-event.deltaY * 0.0015), view = state.view;
    const x = (event.offsetX - canvas.clientWidth / 2) / view.scale;
    const y = (canvas.clientHeight / 2 - event.offsetY) / view.scale;
    const scale = Math.min(Math.max(view.scale * factor, 0.2), 2000);
    view.x += x - x * view.scale / scale;
    view.y += y - y * view.scale / scale;
    view.scale = scale;
    drawMap();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    state.view = mapView();
    drawMap();
  });
}

// One query

function drawOverlay() {
  const canvas = element("overlay"), each = query();
  if (!each) return;
  const hypothesis = each.hypotheses[state.hypothesis];
  const found = hypothesis ? hypothesis.pose || hypothesis.inner : null;
  const pose = state.atTruth && each.truth ? each.truth : found || each.truth || [0, 0, 0];
  const points = placed(scanPoints(each.points), pose);
  // A few readings down a corridor must not shrink the rest.
  const [low, high] = [[pose[0] - 1, pose[1] - 1], [pose[0] + 1, pose[1] + 1]];
  for (const k of [0, 1]) {
    const values = points.filter((_, i) => i % 2 === k).sort();
    if (!values.length) continue;
    low[k] = Math.min(low[k], values[Math.floor(0.04 * values.length)] - 0.7);
    high[k] = Math.max(high[k], values[Math.ceil(0.96 * values.length) - 1] + 0.7);
  }
  const frame = frameOf(canvas, fitting(canvas, low, high));
  const inSet = Boolean(hypothesis && hypothesis.pose);
  if (map() && (inSet || !hypothesis)) drawWalls(frame, map());
  const known = hypothesis ? run().referenceScans[hypothesis.reference] : undefined;
  if (state.showReference && known !== undefined) {
    const [index, reference] = known;
    const there = inSet && reference ? reference : [0, 0, 0];
    drawPoints(frame, placed(scanPoints(index), there), colour("--reference"), 2.4, true);
    drawSensor(frame, there, colour("--reference"), 8);
  }
  drawPoints(frame, points, colour("--right"), 2);
  if (hypothesis && hypothesis.spread) drawEllipse(frame, found, hypothesis.spread, colour("--ink"));
  drawSensor(frame, pose, colour("--right"), 10);
  if (each.truth && (inSet || !hypothesis)) drawSensor(frame, each.truth, colour("--truth"), 13, true);
  drawRuler(frame);
}

function fillHypotheses() {
  const each = query(), table = element("hypotheses");
  table.replaceChildren();
  if (!each || !each.hypotheses.length) return;
  const names = ["", "reference", "x m", "y m", "heading", "probability", "e", "q", "score", "off"];
  table.append(make("thead", {}, make("tr", {}, ...names.map((name) => make("th", { scope: "col" }, name)))));
  const body = make("tbody");
  each.hypotheses.forEach((guess, n) => {
    const pose = guess.pose || guess.inner || [null, null, null];
    const cells = [
      `${n + 1}`, guess.reference === null ? "–" : `${guess.reference}`,
      number(pose[0], 2), number(pose[1], 2), degrees(pose[2]), number(guess.p, 3),
      number(guess.e, 2), number(guess.q, 3), number(guess.score, 3),
      guess.off ? `${number(guess.off[0], 2)} m, ${degrees(guess.off[1])}` : "–",
    ];
    const row = make("tr", { class: n === state.hypothesis ? "choice chosen" : "choice" },
      ...cells.map((cell) => make("td", {}, cell)));
    row.addEventListener("click", () => {
      state.hypothesis = n;
      showQuery();
    });
    body.append(row);
  });
  table.append(body);
}

function showQuery() {
  const each = query();
  element("query-panel").classList.toggle("empty", !each);
  if (!each) {
    element("position").textContent = "no such query";
    element("verdict").textContent = "";
    element("facts").textContent = "";
    fillHypotheses();
    frameOf(element("overlay"), { x: 0, y: 0, scale: 1 });
    drawMap();
    return;
  }
  element("position").textContent = `${state.at + 1} of ${state.list.length}`;
  const alike = each.hypotheses.filter((one) => one.alike).length;
  element("verdict").textContent = `Scan ${each.scan}: ${STATES[stateOf(each)]}`
    + (alike ? `; ambiguous: ${alike} places explain it alike` : "");
  const facts = [];
  if (each.stamp !== null) facts.push(`at ${each.stamp.toFixed(2)} s`);
  if (each.seconds !== null) facts.push(`${(1000 * each.seconds).toFixed(2)} ms`);
  if (each.reason) facts.push(each.reason);
  if (each.points === null) facts.push("its readings are not in this report");
  element("facts").textContent = facts.join(" · ");
  element("truth-choice").hidden = !each.truth;
  fillHypotheses();
  markCase();
  drawOverlay();
  drawMap();
  // Not every browser lets a page from disk change its address.
  try {
    history.replaceState(null, "", `#run=${state.run}&scan=${each.scan}`);
  } catch (error) { /* the page works without */ }
}

function choose(at) {
  state.at = Math.min(Math.max(at, 0), Math.max(state.list.length - 1, 0));
  state.hypothesis = 0;
  showQuery();
}

// The cases

function fillCases() {
  const table = element("cases"), body = make("tbody");
  const names = [["scan", ""], ["what", "words"], ["probability", ""], ["off m", ""], ["off", ""], ["ms", ""]];
  table.replaceChildren(make("thead", {}, make("tr", {},
    ...names.map(([name, kind]) => make("th", { class: kind, scope: "col" }, name)))));
  state.list.slice(0, 100).forEach((n, at) => {
    const each = run().queries[n], best = each.hypotheses[0];
    const cells = [
      [`${each.scan}`, ""], [STATES[stateOf(each)] + (each.reason ? `: ${each.reason}` : ""), "words"],
      [best ? number(best.p, 3) : "–", ""], [best && best.off ? number(best.off[0], 2) : "–", ""],
      [best && best.off ? degrees(best.off[1]) : "–", ""],
      [each.seconds === null ? "–" : (1000 * each.seconds).toFixed(2), ""],
    ];
    const row = make("tr", { class: "choice", tabindex: "0", "data-query": `${n}` },
      ...cells.map(([cell, kind]) => make("td", { class: kind }, cell)));
    row.addEventListener("click", () => choose(at));
    row.addEventListener("keydown", (event) => { if (event.key === "Enter") choose(at); });
    body.append(row);
  });
  table.append(body);
  const many = state.list.length > 100 ? `, the first 100 of ${state.list.length}` : "";
  element("cases-panel").querySelector("h2").textContent =
    `Queries, ${ORDERS[state.order]}${many}`;
}

function markCase() {
  for (const row of element("cases").querySelectorAll("tbody tr")) {
    row.classList.toggle("chosen", Number(row.dataset.query) === state.list[state.at]);
  }
}

// Figures

const BOX = { width: 320, height: 220, left: 40, right: 310, top: 10, bottom: 190 };
const across = (share) => BOX.left + share * (BOX.right - BOX.left);
const up = (share) => BOX.bottom - share * (BOX.bottom - BOX.top);

function chart(id, title, caption, labels, ...marks) {
  const svg = make("svg", { viewBox: `0 0 ${BOX.width} ${BOX.height}`, role: "img", "aria-label": title });
  svg.append(make("path", { class: "axis", d: `M${BOX.left} ${BOX.top}V${BOX.bottom}H${BOX.right}` }));
  for (const [text, x, y, anchor] of labels) {
    svg.append(make("text", { x, y, "text-anchor": anchor || "middle" }, text));
  }
  svg.append(...marks);
  const words = make("figcaption", {}, caption);
  element(id).replaceChildren(make("h2", {}, title), make("figure", {}, svg, words));
  return { svg, words };
}

function drawRecall() {
  const curve = run().curve;
  element("recall").hidden = !curve;
  if (!curve || !curve.length) return;
  const lowest = Math.min(0.5, ...curve.map((each) => each[1]));
  const base = Math.floor(lowest * 10) / 10;
  const y = (precision) => up((precision - base) / (1 - base));
  const path = curve.map((each, n) => `${n ? "L" : "M"}${across(each[0])} ${y(each[1])}`).join("");
  const labels = [["recall", across(0.5), BOX.height - 4], ["0", across(0), BOX.bottom + 14],
    ["1", across(1), BOX.bottom + 14], ["1", BOX.left - 5, y(1) + 4, "end"],
    [base.toFixed(1), BOX.left - 5, y(base) + 4, "end"]];
  const now = counted();
  const marks = [make("path", { class: "curve", d: path })];
  const said = now.right + now.wrong;
  const words = said ? `${now.right} right, ${now.wrong} wrong, ${now.silent} not known: precision `
    + `${percent(now.right / said)}, recall ${percent(now.right / now.all)}. `
    : `Nothing is accepted; ${now.silent} not known. `;
  if (said) {
    marks.push(make("circle", { class: "here", cx: across(now.right / now.all), cy: y(now.right / said), r: 5 }));
  }
  const { svg } = chart("recall", "Precision over recall", `${words}Click the curve for another threshold.`, labels, ...marks);
  svg.addEventListener("click", (event) => {
    const box = svg.getBoundingClientRect();
    const share = ((event.clientX - box.left) / box.width * BOX.width - BOX.left) / (BOX.right - BOX.left);
    let best = curve[0];
    for (const each of curve) if (Math.abs(each[0] - share) < Math.abs(best[0] - share)) best = each;
    setThreshold(best[2]);
  });
}

function counted() {
  const judged = run().judged, now = { right: 0, wrong: 0, silent: 0, all: judged.p.length };
  judged.p.forEach((p, n) => {
    const said = state.threshold === null ? judged.accepted[n] : p !== null && p >= state.threshold;
    now[said ? (judged.right[n] ? "right" : "wrong") : "silent"] += 1;
  });
  return now;
}

function drawReliability() {
  const bins = run().reliability;
  element("reliability").hidden = !bins;
  if (!bins) return;
  const marks = [make("path", { class: "ideal", d: `M${across(0)} ${up(0)}L${across(1)} ${up(1)}` })];
  const most = Math.max(...bins.counts, 1);
  bins.counts.forEach((count, n) => {
    if (!count) return;
    const wide = (BOX.right - BOX.left) / bins.counts.length;
    const bar = make("rect", {
      class: "bar", x: across(n / bins.counts.length) + 1, y: up(bins.accuracy[n]),
      width: wide - 2, height: BOX.bottom - up(bins.accuracy[n]), opacity: 0.25 + 0.75 * Math.sqrt(count / most),
    });
    const words = `${count} answers: said ${percent(bins.probability[n])}, right ${percent(bins.accuracy[n])}`;
    bar.append(make("title", {}, words));
    const dot = make("circle", { class: "dot", cx: across(bins.probability[n]), cy: up(bins.accuracy[n]), r: 3.5 });
    dot.append(make("title", {}, words));
    marks.push(bar, dot);
  });
  const labels = [["reported probability", across(0.5), BOX.height - 4], ["0", across(0), BOX.bottom + 14],
    ["1", across(1), BOX.bottom + 14], ["1", BOX.left - 5, up(1) + 4, "end"], ["0", BOX.left - 5, up(0) + 4, "end"]];
  chart("reliability", "Reliability",
    `Share that is right over what was said; on the dashed line it is honest. Strong bars hold many answers. `
    + `Expected calibration error ${number(bins.error, 3)}.`, labels, ...marks);
}

function drawTimes() {
  const times = run().times;
  element("times").hidden = !times;
  if (!times) return;
  const most = Math.max(...times.counts, 1), wide = (BOX.right - BOX.left) / times.counts.length;
  const marks = times.counts.map((count, n) => {
    const bar = make("rect", { class: "bar", x: across(n / times.counts.length) + 0.5, y: up(count / most),
      width: Math.max(wide - 1, 0.5), height: BOX.bottom - up(count / most) });
    bar.append(make("title", {}, `${count} scans: ${milliseconds(times.edges[n])} to ${milliseconds(times.edges[n + 1])} ms`));
    return bar;
  });
  const last = times.edges.length - 1;
  const labels = [["milliseconds a scan", across(0.5), BOX.height - 4],
    [milliseconds(times.edges[0]), across(0), BOX.bottom + 14],
    [milliseconds(times.edges[last]), across(1), BOX.bottom + 14],
    [`${most}`, BOX.left - 5, up(1) + 4, "end"]];
  chart("times", "Time", `Logarithmic. ${times.words}`, labels, ...marks);
}

function fillFigures() {
  element("figures").replaceChildren(make("tbody", {}, ...run().figures.map(([name, value]) =>
    make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, value)))));
}

function setThreshold(value) {
  const chosen = state.list[state.at];
  state.threshold = value;
  element("threshold-value").textContent = value === null ? "" : value.toFixed(3);
  element("threshold").value = value === null ? run().threshold : value;
  arrange(chosen);
  fillLegend();
  fillCases();
  drawRecall();
  showQuery();
}

// Legends and choices

function symbol(kind) {
  const svg = make("svg", { viewBox: "0 0 14 14", "aria-hidden": "true" });
  const stroke = (name) => `fill:none;stroke:var(${name});stroke-width:2`;
  if (kind === "wrong") {
    svg.append(make("path", { d: "M3 3L11 11M3 11L11 3", style: stroke("--wrong") }));
  } else if (kind === "reference") {
    svg.append(make("path", { d: "M2 7H12", style: "stroke:var(--soft)" }),
      make("circle", { cx: 3, cy: 7, r: 2, style: "fill:none;stroke:var(--soft)" }));
  } else if (kind === "best" || kind === "scan" || kind === "truth") {
    const fill = { best: "--reference", scan: "--right", truth: null }[kind];
    svg.append(make("path", { d: "M12 7L3 12V2Z",
      style: fill ? `fill:var(${fill});stroke:var(--ink)` : stroke("--truth") }));
  } else if (kind === "right" || kind === "located") {
    svg.append(make("circle", { cx: 7, cy: 7, r: 5, style: "fill:var(--right)" }));
  } else {
    svg.append(make("circle", { cx: 7, cy: 7, r: 4.5, style: stroke(COLOURS[kind]) }));
  }
  return svg;
}

function fillLegend() {
  const counts = {};
  for (const each of run().queries) {
    const kind = stateOf(each);
    counts[kind] = (counts[kind] || 0) + 1;
  }
  const item = (kind, words) => make("li", {}, symbol(kind), words);
  const items = Object.keys(STATES).filter((kind) => counts[kind])
    .map((kind) => item(kind, `${STATES[kind]}: ${counts[kind]}`));
  if (map() && map().references.length) items.push(item("reference", `reference: ${map().references.length}`));
  items.push(item("best", "best guess of the chosen query"));
  const truths = run().queries.some((each) => each.truth);
  if (truths) items.push(item("truth", "the log's pose of it"));
  element("legend").replaceChildren(...items);
  const below = [item("scan", "scan"), item("best", "reference scan")];
  if (truths) below.push(item("truth", "the log's pose"));
  element("overlay-legend").replaceChildren(...below);
}

function fillSelect(id, choices, value) {
  element(id).replaceChildren(...choices.map(([key, words]) => make("option", { value: key }, words)));
  element(id).value = value;
}

function showRun(scan) {
  state.view = null;
  state.threshold = null;
  state.filter = "all";
  const some = new Set(run().queries.map(stateOf));
  const filters = [["all", "all"], ...Object.entries(STATES).filter(([kind]) => some.has(kind))];
  if (some.has("unknownRight") && some.has("unknownWrong")) filters.push(["anyUnknown", "all not known"]);
  fillSelect("filter", filters, "all");
  element("threshold-choice").hidden = !run().curve;
  element("threshold").value = run().threshold;
  element("threshold-value").textContent = "";
  element("notes").replaceChildren(...[...data.notes, ...run().notes].map((note) => make("li", {}, note)));
  const found = run().queries.findIndex((each) => each.scan === scan);
  arrange(found < 0 ? undefined : found);
  fillLegend();
  fillCases();
  fillFigures();
  drawRecall();
  drawReliability();
  drawTimes();
  showQuery();
}

function listen() {
  element("previous").addEventListener("click", () => choose(state.at - 1));
  element("next").addEventListener("click", () => choose(state.at + 1));
  element("run").addEventListener("change", (event) => {
    state.run = Number(event.target.value);
    showRun();
  });
  for (const name of ["order", "filter"]) {
    element(name).addEventListener("change", (event) => {
      state[name] = event.target.value;
      arrange();
      fillCases();
      showQuery();
    });
  }
  element("at-truth").addEventListener("change", (event) => {
    state.atTruth = event.target.checked;
    drawOverlay();
  });
  element("show-reference").addEventListener("change", (event) => {
    state.showReference = event.target.checked;
    drawOverlay();
  });
  element("threshold").addEventListener("input", (event) => setThreshold(Number(event.target.value)));
  element("as-decided").addEventListener("click", () => setThreshold(null));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const typing = ["SELECT", "INPUT"].includes(event.target.tagName) && event.target.type !== "checkbox";
    if (typing) return;
    const each = query(), count = each ? each.hypotheses.length : 0;
    const act = {
      ArrowRight: () => choose(state.at + 1),
      ArrowLeft: () => choose(state.at - 1),
      Home: () => choose(0),
      End: () => choose(state.list.length - 1),
      ArrowDown: () => { state.hypothesis = Math.min(state.hypothesis + 1, Math.max(count - 1, 0)); showQuery(); },
      ArrowUp: () => { state.hypothesis = Math.max(state.hypothesis - 1, 0); showQuery(); },
      t: () => element("at-truth").click(),
      T: () => element("at-truth").click(),
    }[event.key];
    if (act) {
      event.preventDefault();
      act();
    }
  });
  let waiting = null;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => { state.view = null; drawMap(); drawOverlay(); }, 100);
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    drawMap();
    drawOverlay();
  });
  listenToMap();
}

function start() {
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (Number(wanted.get("run")) in data.runs) state.run = Number(wanted.get("run"));
  fillSelect("run", data.runs.map((each, n) => [`${n}`, each.name]), `${state.run}`);
  element("run-choice").hidden = data.runs.length < 2;
  fillSelect("order", Object.entries(ORDERS), state.order);
  listen();
  showRun(wanted.has("scan") ? Number(wanted.get("scan")) : undefined);
}

start();
