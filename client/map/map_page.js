// The script of map_page.html: draws the map, moves it, shows numbers.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const { nodes, recordings, checks, styles, closures, rejections, truth, colors } = data;
const canvas = document.getElementById("map");
const pen = canvas.getContext("2d");
const panel = document.getElementById("panel");
const byId = (id) => document.getElementById(id);
document.title = data.title;
byId("title").textContent = data.title;
byId("subtitle").textContent = data.subtitle;

// ---- The view: metres in the middle of the window, and pixels per metre.

let view = { x: 0, y: 0, scale: 1 };
let chosen = null;
const shown = { ellipses: true, truth: true, closures: true, rejections: true,
                styles: styles.map(() => true) };

// Smaller marks where checks lie close together on the screen.
const spacing = checks.length < 2 ? Infinity
  : (nodes.travelled[checks[checks.length - 1].node] - nodes.travelled[checks[0].node]) /
    (checks.length - 1);
const markSize = () => Math.min(Math.max(spacing * view.scale / 40, 0.4), 1);

const toPixels = (x, y) => [
  canvas.clientWidth / 2 + (x - view.x) * view.scale,
  canvas.clientHeight / 2 - (y - view.y) * view.scale];
const atNode = (i) => toPixels(nodes.x[i], nodes.y[i]);

// Parts of the window that neither the title nor the legend covers, beside it
// and above it, if they are large enough; the whole window last.
function freeParts() {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const head = byId("head").getBoundingClientRect();
  const legend = byId("legend").getBoundingClientRect();
  const zoomTop = byId("zoom").getBoundingClientRect().top - 40;
  const parts = [
    { left: legend.right, top: head.bottom, right: width, bottom: zoomTop },
    { left: 0, top: head.bottom, right: width, bottom: Math.min(legend.top, zoomTop) }];
  return parts.filter((p) => p.right - p.left > 100 && p.bottom - p.top > 100)
    .concat([{ left: 0, top: 0, right: width, bottom: height }]);
}

function fit() {
  let [west, east, south, north] = [Infinity, -Infinity, Infinity, -Infinity];
  for (let i = 0; i < nodes.x.length; ++i) {
    west = Math.min(west, nodes.x[i]); east = Math.max(east, nodes.x[i]);
    south = Math.min(south, nodes.y[i]); north = Math.max(north, nodes.y[i]);
  }
  const scaleIn = (part) =>
    0.9 * Math.min((part.right - part.left) / Math.max(east - west, 1),
                   (part.bottom - part.top) / Math.max(north - south, 1));
  const free = freeParts();
  const part = free.length === 1 ? free[0]
    : free.slice(0, -1).reduce((a, b) => (scaleIn(b) > scaleIn(a) ? b : a));
  const scale = scaleIn(part);
  // What lies in the middle of the part lies beside the middle of the window.
  view = { x: (west + east) / 2 + (canvas.clientWidth - part.left - part.right) / 2 / scale,
           y: (south + north) / 2 - (canvas.clientHeight - part.top - part.bottom) / 2 / scale,
           scale };
  draw();
}

function zoom(factor, px, py) {
  const dx = px - canvas.clientWidth / 2;
  const dy = canvas.clientHeight / 2 - py;
  const scale = Math.min(Math.max(view.scale * factor, 1e-4), 1e4);
  view.x += dx / view.scale - dx / scale;
  view.y += dy / view.scale - dy / scale;
  view.scale = scale;
  draw();
}

// ---- Drawing

// The nodes of each recording with their colour; all nodes where there is one.
const stretches = recordings.length === 0
  ? [{ begin: 0, end: nodes.x.length, color: colors.estimate }]
  : recordings.map((recording, k) => ({
    begin: recording.node, color: recording.color, vehicle: recording.vehicle,
    end: k + 1 < recordings.length ? recordings[k + 1].node : nodes.x.length }));

function path(xs, ys, begin, end, color, width) {
  pen.beginPath();
  for (let i = begin; i < end; ++i) {
    const [x, y] = toPixels(xs[i], ys[i]);
    if (i === begin || nodes.cut[i]) pen.moveTo(x, y); else pen.lineTo(x, y);
  }
  pen.strokeStyle = color;
  pen.lineWidth = width;
  pen.stroke();
}

// Where the vehicle goes: heads of arrows along the path, some way apart on the
// screen.
function arrows(begin, end, color) {
  const [apart, step] = [150, 6];
  let since = apart / 2;
  let [px, py] = atNode(begin);
  pen.fillStyle = color;
  for (let i = begin + 1; i < end; ++i) {
    const [x, y] = atNode(i);
    if (nodes.cut[i]) [px, py] = [x, y];
    const [dx, dy] = [x - px, y - py];
    const length = Math.hypot(dx, dy);
    if (length < step) continue;
    since += length;
    if (since >= apart) {
      since = 0;
      const [ux, uy] = [dx / length, dy / length];
      const [mx, my] = [(x + px) / 2, (y + py) / 2];
      pen.beginPath();
      pen.moveTo(mx + 7 * ux, my + 7 * uy);
      pen.lineTo(mx - 5 * ux - 5 * uy, my - 5 * uy + 5 * ux);
      pen.lineTo(mx - 5 * ux + 5 * uy, my - 5 * uy - 5 * ux);
      pen.fill();
    }
    [px, py] = [x, y];
  }
}

function line(from, to, color, width, dash) {
  pen.beginPath();
  pen.setLineDash(dash || []);
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.strokeStyle = color;
  pen.lineWidth = width;
  pen.stroke();
  pen.setLineDash([]);
}

function dot([x, y], radius, fill, edge, width) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  pen.fillStyle = fill;
  pen.fill();
  pen.strokeStyle = edge;
  pen.lineWidth = width;
  pen.stroke();
}

function ellipse(check, strong) {
  const [x, y] = atNode(check.node);
  const [major, minor, direction] = check.ellipse;
  pen.beginPath();
  pen.ellipse(x, y, Math.max(major * view.scale, 0.1),
              Math.max(minor * view.scale, 0.1), -direction, 0, 2 * Math.PI);
  pen.globalAlpha = strong ? 0.15 : 0.03;
  pen.fillStyle = colors.ellipse;
  pen.fill();
  pen.globalAlpha = strong ? 0.9 : 0.35;
  pen.strokeStyle = colors.ellipse;
  pen.lineWidth = 1;
  pen.stroke();
  pen.globalAlpha = 1;
}

function pair(query, matched, confirmed) {
  const [from, to] = [atNode(query), atNode(matched)];
  pen.globalAlpha = confirmed ? 0.5 : 1;
  line(from, to, confirmed ? colors.closure : colors.rejection,
       confirmed ? 7 : 2, confirmed ? [] : [2, 3]);
  pen.globalAlpha = 1;
  if (confirmed) return;
  const [x, y] = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
  line([x - 4, y - 4], [x + 4, y + 4], colors.rejection, 2);
  line([x - 4, y + 4], [x + 4, y - 4], colors.rejection, 2);
}

function link(check, candidate, style, size) {
  const [from, to] = [atNode(check.node), atNode(candidate.node)];
  line(from, to, "rgba(255,255,255,0.85)", 5 * size);
  line(from, to, style.color, 2.6 * size, style.dashed ? [7 * size, 5 * size] : []);
  dot(to, 3.2 * size, "#fff", style.color, 1.8 * size);
}

function scaleBar() {
  const most = canvas.clientWidth * 0.15 / view.scale;
  const power = 10 ** Math.floor(Math.log10(most));
  const meters = [5, 2, 1].map((f) => f * power).find((m) => m <= most);
  const [x, y] = [canvas.clientWidth - 20, canvas.clientHeight - 66];
  const left = x - meters * view.scale;
  pen.fillStyle = "rgba(255,255,255,0.85)";
  pen.fillRect(left - 8, y - 26, x - left + 16, 36);
  line([left, y], [x, y], "#222", 2.5);
  line([left, y - 5], [left, y + 5], "#222", 2);
  line([x, y - 5], [x, y + 5], "#222", 2);
  pen.fillStyle = "#222";
  pen.textAlign = "center";
  pen.fillText(`${+meters.toPrecision(3)} m`, (left + x) / 2, y - 9);
}

function drawChosen() {
  if (!chosen) return;
  if (chosen.pair) {
    for (const node of chosen.pair) dot(atNode(node), 8, "rgba(0,0,0,0)", "#000", 2);
    return;
  }
  ellipse(chosen.check, true);
  for (const candidate of chosen.check.candidates) {
    line(atNode(chosen.check.node), atNode(candidate.node), "#000", 1, [3, 3]);
    dot(atNode(candidate.node), 5, "rgba(0,0,0,0)", "#000", 1.5);
  }
  dot(atNode(chosen.check.node), 8, "rgba(0,0,0,0)", "#000", 2);
}

// Tags at the two ends of the vehicle's own drive, on either side where they lie together.
function drawEnds() {
  const [start, end] = [atNode(data.own_begin), atNode(nodes.x.length - 1)];
  const together = Math.abs(start[0] - end[0]) < 60 && Math.abs(start[1] - end[1]) < 40;
  const endIsLower = end[1] > start[1];
  pen.textAlign = "center";
  for (const [[x, y], text, fill, above] of [
    [start, "start", colors.estimate, !together || endIsLower],
    [end, "end", "#fff", !together || !endIsLower]]) {
    pen.fillStyle = fill;
    pen.strokeStyle = colors.estimate;
    pen.lineWidth = 2;
    pen.fillRect(x - 5.5, y - 5.5, 11, 11);
    pen.strokeRect(x - 5.5, y - 5.5, 11, 11);
    pen.fillStyle = "#222";
    pen.fillText(text, x, above ? y - 11 : y + 20);
  }
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [window.innerWidth, window.innerHeight];
  if (canvas.width !== Math.round(width * ratio) ||
      canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    canvas.style.width = `${width}px`;
    canvas.style.height = `${height}px`;
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.font = "13px sans-serif";
  pen.lineJoin = pen.lineCap = "round";
  pen.fillStyle = "#fff";
  pen.fillRect(0, 0, width, height);
  const visible = checks.filter((check) => shown.styles[check.style]);
  if (shown.ellipses) visible.forEach((check) => ellipse(check, false));
  if (truth && shown.truth) path(truth.x, truth.y, 0, truth.x.length, colors.truth, 1.2);
  const size = markSize();
  for (const { begin, end, color } of stretches) {
    path(nodes.x, nodes.y, begin, end, color, 0.8 + 1.2 * size);
    arrows(begin, end, color);
  }
  if (shown.rejections) rejections.forEach((p) => pair(p.query, p.matched, false));
  if (shown.closures) closures.forEach((p) => pair(p.query, p.matched, true));
  for (const check of visible) {
    const style = styles[check.style];
    if (style.link) link(check, check.candidates[0], style, size);
  }
  for (const check of visible) {
    const style = styles[check.style];
    dot(atNode(check.node), 4.2 * size, style.color, style.link ? "#fff" : "#222", 1.2 * size);
  }
  drawEnds();
  drawChosen();
  scaleBar();
}

// ---- Numbers of what was clicked

// The other vehicle that a node is of; "" where it is none.
const vehicleOf = (node) =>
  stretches.find(({ begin, end }) => begin <= node && node < end).vehicle || "";

const place = (node) =>
  `${vehicleOf(node) && vehicleOf(node) + ", "}sequence ${nodes.sequence[node]}, ${nodes.travelled[node].toFixed(1)} m` +
  (nodes.time ? `, ${nodes.time[node]}` : "");

function element(tag, text, kind) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

function openPanel(title, ...parts) {
  const close = element("button", "\u00d7", "close");
  close.onclick = () => { chosen = null; panel.style.display = "none"; draw(); };
  panel.replaceChildren(close, element("h2", title), ...parts);
  panel.style.display = "block";
  draw();
}

// Nothing tells a distance where nothing tells how two frames lie to each other.
const fixed = (number, digits) => (number === undefined ? "-" : number.toFixed(digits));

const columns = [
  ["", (c, i) => i + 1],
  ["verdict", (c) => c.verdict, "word"],
  ["probability", (c) => (c.probability === undefined ? "-" : c.probability.toFixed(4))],
  ["along m", (c) => (c.probability === undefined ? "-"
    : `${(-c.before).toFixed(0)} to ${c.after.toFixed(0)}`)],
  ["vehicle", (c) => vehicleOf(c.node) || "itself", "word"],
  ["sequence", (c) => nodes.sequence[c.node]],
  ["travelled m", (c) => nodes.travelled[c.node].toFixed(1)],
  ["direction", (c) => (c.opposite ? "opposite" : "same"), "word"],
  ["frame", (c) => (c.frame ? c.frame.toLowerCase() : "-"), "word"],
  ["gate", (c) => c.gate, "word"],
  ["d2", (c) => fixed(c.d2, 2)],
  ["threshold", (c) => fixed(c.threshold, 2)],
  ["p-value", (c) => fixed(c.p_value, 4)],
  ["time", (c) => nodes.time[c.node], "word"],
].filter(([name]) => (name !== "time" || nodes.time) &&
                     (name !== "vehicle" || data.own_begin > 0) &&
                     (name !== "frame" || recordings.length > 0));

function candidateTable(check) {
  const table = element("table");
  const head = table.insertRow();
  for (const [name, , kind] of columns) head.append(element("th", name, kind));
  check.candidates.forEach((candidate, i) => {
    const row = table.insertRow();
    row.className = "candidate";
    row.title = "shows the place";
    for (const [, value, kind] of columns) row.append(element("td", value(candidate, i), kind));
    row.onclick = () => {
      view.x = nodes.x[candidate.node];
      view.y = nodes.y[candidate.node];
      draw();
    };
  });
  return table;
}

function choose(px, py) {
  let best = 14;
  let found = null;
  const consider = (node, made) => {
    const [x, y] = atNode(node);
    const distance = Math.hypot(x - px, y - py);
    if (distance < best) { best = distance; found = made; }
  };
  const pairs = [[shown.rejections, rejections], [shown.closures, closures]];
  for (const [isShown, list] of pairs) {
    if (!isShown) continue;
    for (const p of list) {
      const made = { pair: [p.query, p.matched], name: p.name, note: p.note };
      consider(p.query, made);
      consider(p.matched, made);
    }
  }
  for (const check of checks) {
    if (!shown.styles[check.style]) continue;
    // Where two lie at one point, the check's own place comes first.
    consider(check.node, { check });
    if (styles[check.style].link) {
      best -= 0.5;
      consider(check.candidates[0].node, { check });
      best += 0.5;
    }
  }
  chosen = found;
  if (!found) {
    panel.style.display = "none";
    draw();
  } else if (found.pair) {
    openPanel(found.name, element("div", `query: ${place(found.pair[0])}`),
              element("div", `match: ${place(found.pair[1])}`),
              ...found.note ? [element("div", `note: ${found.note}`, "note")] : []);
  } else {
    const { check } = found;
    openPanel(`check at ${place(check.node)}`,
              check.candidates.length ? candidateTable(check)
                                      : element("div", `no candidates: ${check.empty_reason}`));
  }
}

// ---- Legend: what is shown

function legendEntry(text, draw_, set) {
  const label = element("label");
  const box = element("input");
  box.type = "checkbox";
  box.checked = true;
  box.disabled = !set;
  box.onchange = () => { set(box.checked); draw(); };
  const sample = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  sample.setAttribute("width", 34);
  sample.setAttribute("height", 14);
  sample.innerHTML = draw_;
  label.append(box, sample, element("span", text));
  byId("legend").append(label);
}

const sampleLine = (color, width, dash) =>
  `<line x1="2" y1="7" x2="32" y2="7" stroke="${color}" stroke-width="${width}" ` +
  `stroke-dasharray="${dash}"/>`;
if (recordings.length === 0) {
  legendEntry("estimated trajectory", sampleLine(colors.estimate, 2, ""), null);
}
// The newest ones; the window holds no more.
const named = recordings.slice(-8);
if (named.length < recordings.length) {
  legendEntry(`${recordings.length - named.length} recordings before these`,
              sampleLine(colors.estimate, 0, ""), null);
}
named.forEach((recording) => legendEntry(
  recording.label, sampleLine(recording.color, 2, ""), null));
if (truth) {
  legendEntry("true trajectory", sampleLine(colors.truth, 1.2, ""), (on) => { shown.truth = on; });
}
if (checks.length) {
  legendEntry("95 % uncertainty at a check",
              `<ellipse cx="17" cy="7" rx="14" ry="6" fill="none" stroke="${colors.ellipse}"/>`,
              (on) => { shown.ellipses = on; });
}
styles.forEach((style, i) => legendEntry(
  style.label,
  style.link
    ? sampleLine(style.color, 2.6, style.dashed ? "7 5" : "") +
      `<circle cx="5" cy="7" r="4" fill="${style.color}"/>`
    : `<circle cx="17" cy="7" r="4.4" fill="${style.color}" stroke="#222"/>`,
  (on) => { shown.styles[i] = on; }));
if (closures.length) {
  legendEntry(`confirmed: ${closures.length}`, sampleLine(colors.closure, 6, ""),
              (on) => { shown.closures = on; });
}
if (rejections.length) {
  legendEntry(`rejected: ${rejections.length}`, sampleLine(colors.rejection, 2, "2 3"),
              (on) => { shown.rejections = on; });
}

// ---- Mouse, fingers, keys

const pointers = new Map();
let moved = 0;
canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  if (pointers.size === 1) moved = 0;
  canvas.classList.add("drag");
};
canvas.onpointermove = (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY];
  const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
  moved += Math.hypot(dx, dy);
  if (pointers.size === 2) {
    const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
    const spread = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
    pointers.set(event.pointerId, now);
    zoom(spread(now) / Math.max(spread(before), 1),
         (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    return;
  }
  pointers.set(event.pointerId, now);
  view.x -= dx / view.scale;
  view.y += dy / view.scale;
  draw();
};
canvas.onpointerup = canvas.onpointercancel = (event) => {
  const clicked = pointers.size === 1 && moved < 4 && event.type === "pointerup";
  pointers.delete(event.pointerId);
  canvas.classList.remove("drag");
  if (clicked) choose(event.clientX, event.clientY);
};
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.clientX, event.clientY);
}, { passive: false });
const middle = (factor) => zoom(factor, canvas.clientWidth / 2, canvas.clientHeight / 2);
byId("in").onclick = () => middle(1.5);
byId("out").onclick = () => middle(1 / 1.5);
byId("fit").onclick = fit;
window.onkeydown = (event) => {
  if (event.key === "+") middle(1.5);
  if (event.key === "-") middle(1 / 1.5);
  if (event.key === "0") fit();
  if (event.key === "Escape") { chosen = null; panel.style.display = "none"; draw(); }
};
window.onresize = draw;
draw();
fit();
