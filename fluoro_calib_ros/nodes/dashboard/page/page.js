// SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// The page of fluoro-calib watch --web: asks for the state twice a second, and shows it.

'use strict';

const PERIOD_MS = 500;
const MARKS = {ok: '✓', warn: '!', error: '✕', busy: '…'};
const BEAD = '#5ee37b';
const SOURCE = '#ffc14d';
const BEAM = '#7a5a1c';
const AXES = ['#ff7b72', '#6fdd8b', '#79b8ff'];
const CONFIRMATIONS = {
  reset: 'Discard all exposures that were collected? The calibration stays.',
  roll_back_healing: 'Return to the rig as it was before it was healed?',
};
const ARROW_PX = 18; // of a large residual, 95 % are smaller

const by = (id) => document.getElementById(id);
const views = new Map(); // elements by fluoroscope
let exposures = null;
let calibrated = '';
let sound = null; // AudioContext
let space = {points: [], sources: []};
const camera = {turn: 0.6, tilt: 0.4, zoom: 1};

async function ask(path) {
  const answer = await fetch(path);
  if (answer.status === 204) return null;
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Rows [heading, text, class] of a table.
function fillRows(body, rows) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach(([heading, text, kind], index) => {
    let row = body.rows[index];
    if (!row) {
      row = body.insertRow();
      const head = document.createElement('th');
      head.scope = 'row';
      row.append(head, document.createElement('td'));
    }
    put(row.cells[0], heading);
    put(row.cells[1], text);
    row.cells[1].className = kind || '';
  });
}

function fillList(list, texts) {
  while (list.children.length > texts.length) list.lastChild.remove();
  texts.forEach((text, index) => {
    if (!list.children[index]) list.append(document.createElement('li'));
    put(list.children[index], text);
  });
}

const number = (value, digits = 1) => value === null ? '-' : value.toFixed(digits);
const rate = (hz) => hz === null ? '-' : `${number(hz)} a second`;

function duration(seconds) {
  for (const [unit, length] of [['d', 86400], ['h', 3600], ['min', 60]]) {
    if (seconds >= 2 * length) return `${Math.round(seconds / length)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

function viewOf(name) {
  if (!views.has(name)) {
    const view = by('view').content.cloneNode(true).firstElementChild;
    view.querySelector('h3').textContent = `Fluoroscope ${name}`;
    view.querySelector('canvas').setAttribute('aria-label', `Radiograph of fluoroscope ${name}`);
    by('views').append(view);
    views.set(name, view);
  }
  return views.get(name);
}

function calibrationText(f) {
  const [u, v] = f.rmse_px;
  const residuals = u === null ? '' : `RMSE ${number(u, 3)}, ${number(v, 3)} px`;
  if (f.state === 'calibrating') return `round ${f.iteration}, ${residuals}`;
  if (!f.calibration_id) return 'none';
  return [f.age_s === null ? '' : `${duration(f.age_s)} ago`, residuals].filter(Boolean).join(', ');
}

function showFluoroscope(f, mas, doses) {
  const view = viewOf(f.name);
  put(view.querySelector('.pose'), f.next_pose ? `Next pose: ${f.next_pose}` : '');
  const load = mas && !doses[f.name] ? `, ${number(mas * f.frames, 2)} mAs` : '';
  const rows = [
    ['State', f.state || '-'],
    ['Exposures', `${f.exposures}, ${Math.round(100 * f.coverage)} % of the image covered`],
    ['Frames', `${rate(f.frames_hz)}, ${f.frames} so far${load}`],
    ['Calibration', calibrationText(f)],
    ['Corrected', rate(f.corrected_hz)],
  ];
  if (doses[f.name]) rows.push(['Dose', doses[f.name]]);
  if (f.rejected) rows.push(['Refused', `${f.rejected} frames`, 'warn']);
  fillRows(view.querySelector('tbody'), rows);
}

function showState(state) {
  by('light').className = `light ${state.light.level}`;
  put(by('mark'), MARKS[state.light.level]);
  put(by('word'), state.light.word);
  put(by('sentence'), state.light.sentence);
  document.title = `${state.light.word} - fluoroscopes ${state.namespace}`;
  state.fluoroscopes.forEach((f) => showFluoroscope(f, state.mas, state.doses));
  fillRows(by('results'), [
    ['Verdict', state.verdict || 'none on the calibration in use', state.verdict],
    ['Orientation', state.orientation || 'none yet'],
    ['Drift', state.drift || '-', state.drift_level],
    ...(state.diagnosis.verdict ? [['Healing', state.diagnosis.verdict, state.diagnosis.verdict]] : []),
    ['Points', rate(state.points_hz)],
  ]);
  fillList(by('findings'), [...state.findings, ...state.diagnosis.findings]);
  by('accept').hidden = !state.acceptable;
  by('roll-back').hidden = state.orientation !== 'healing';
  fillNodes(state.nodes);
  fillList(by('log'), state.log.slice(-8).reverse());
  ring(state.fluoroscopes);
  const ids = state.fluoroscopes.map((f) => f.calibration_id).join(' ').trim();
  if (ids !== calibrated && !state.job) {
    calibrated = ids;
    showResiduals();
  }
}

function fillNodes(nodes) {
  const body = by('nodes');
  while (body.rows.length > nodes.length) body.deleteRow(-1);
  nodes.forEach((node, index) => {
    const row = body.rows[index] || body.insertRow();
    while (row.cells.length < 3) row.insertCell();
    [node.name, node.level, node.message].forEach((text, k) => put(row.cells[k], text));
    row.cells[1].className = node.level;
  });
}

// A tone for each collected pose.
function ring(fluoroscopes) {
  const count = fluoroscopes.reduce((sum, f) => sum + f.exposures, 0);
  if (sound && exposures !== null && count > exposures) {
    const tone = sound.createOscillator();
    const level = sound.createGain();
    tone.frequency.value = 880;
    level.gain.setValueAtTime(0.3, sound.currentTime);
    level.gain.exponentialRampToValueAtTime(0.001, sound.currentTime + 0.4);
    tone.connect(level).connect(sound.destination);
    tone.start();
    tone.stop(sound.currentTime + 0.4);
  }
  exposures = count;
}

function load(source) {
  return new Promise((resolve) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => resolve(null);
    image.src = source;
  });
}

async function showRadiograph(name) {
  const view = viewOf(name);
  const canvas = view.querySelector('.radiograph');
  const found = await ask(`/fluoroscopes/${name}/radiograph`);
  if (!found || !found.width) {
    put(canvas.nextElementSibling, 'no images and no image points yet');
    return;
  }
  const image = found.jpeg ? await load(found.jpeg) : null;
  const factor = Math.min(1, 768 / Math.max(found.width, found.height));
  canvas.width = Math.round(found.width * factor);
  canvas.height = Math.round(found.height * factor);
  const pen = canvas.getContext('2d');
  if (image) pen.drawImage(image, 0, 0, canvas.width, canvas.height);
  pen.strokeStyle = BEAD;
  pen.lineWidth = 1.5;
  for (const [, u, v] of found.points) {
    pen.beginPath();
    pen.arc((u + 0.5) * factor, (v + 0.5) * factor, 6, 0, 2 * Math.PI);
    pen.stroke();
  }
  const count = found.points.length;
  const text = (count ? `${count} targets found` : 'nothing found in this image, or not yet')
    + (found.age > 1 ? `; ${duration(found.age)} older than the newest image` : '')
    + (found.jpeg ? '' : '; this rig sends no images');
  put(canvas.nextElementSibling, text);
  canvas.setAttribute('aria-label', `Radiograph of fluoroscope ${name}: ${text}`);
}

async function showCoverage(name) {
  const picture = viewOf(name).querySelector('.coverage');
  const answer = await fetch(`/fluoroscopes/${name}/coverage`);
  if (answer.status !== 200) return;
  const url = URL.createObjectURL(await answer.blob());
  picture.onload = () => URL.revokeObjectURL(url);
  picture.src = url;
  picture.alt = `Coverage of the image of fluoroscope ${name}; a frame marks the next pose`;
  picture.hidden = false;
}

// Points in space.

function rotated([x, y, z]) {
  const across = Math.cos(camera.turn) * x + Math.sin(camera.turn) * y;
  const depth = Math.cos(camera.turn) * y - Math.sin(camera.turn) * x;
  return [across, Math.cos(camera.tilt) * z - Math.sin(camera.tilt) * depth];
}

function drawSpace() {
  const canvas = by('space');
  const pen = canvas.getContext('2d');
  pen.clearRect(0, 0, canvas.width, canvas.height);
  const points = space.points.map((row) => row.slice(1, 4));
  const near = points.length ? points : space.sources.map((source) => source.position);
  if (!near.length) return;
  const centre = [0, 1, 2].map((k) => {
    const values = near.map((p) => p[k]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  const size = Math.max(50, ...near.map((p) => Math.hypot(...p.map((x, k) => x - centre[k]))));
  const scale = 0.45 * camera.zoom * Math.min(canvas.width, canvas.height) / size;
  const place = (p) => {
    const [across, up] = rotated(p.map((x, k) => x - centre[k]));
    return [canvas.width / 2 + scale * across, canvas.height / 2 - scale * up];
  };
  const line = (from, to, colour) => {
    pen.strokeStyle = colour;
    pen.beginPath();
    pen.moveTo(...place(from));
    pen.lineTo(...place(to));
    pen.stroke();
  };
  pen.lineWidth = 2;
  pen.font = '14px system-ui, sans-serif';
  AXES.forEach((colour, k) => line([0, 0, 0], [0, 1, 2].map((j) => j === k ? size / 6 : 0), colour));
  for (const source of space.sources) {
    const length = Math.hypot(...source.position.map((x, k) => x - centre[k])) + size;
    line(source.position, source.position.map((x, k) => x + length * source.axis[k]), BEAM);
    pen.fillStyle = SOURCE;
    const [x, y] = place(source.position);
    pen.fillRect(x - 5, y - 5, 10, 10);
    pen.fillText(source.name, x + 9, y + 5);
  }
  for (const [, x, y, z, status] of space.points) {
    pen.fillStyle = status === 0 ? BEAD : SOURCE;
    pen.beginPath();
    pen.arc(...place([x, y, z]), 3.5, 0, 2 * Math.PI);
    pen.fill();
  }
}

async function showSpace() {
  space = await ask('/space') || space;
  const text = space.points.length
    ? `${space.points.length} points of frame ${space.frame}, and ${space.sources.length} sources`
    : space.sources.length ? `${space.sources.length} sources, no points` : 'none yet';
  put(by('space-text'), text);
  by('space').setAttribute('aria-label', `Points in space: ${text}`);
  drawSpace();
}

// Residual vectors of the calibration.

async function showResiduals() {
  by('residuals').replaceChildren();
  by('report').hidden = true;
  if (!calibrated) return;
  const wanted = calibrated;
  let found;
  try {
    found = await ask('/residuals');
    if (wanted !== calibrated) return; // asked for again: the fluoroscopes tell one after the other
  } catch (error) {
    put(by('residuals-text'), error.message);
    return;
  }
  const names = Object.keys(found.fluoroscopes);
  put(by('residuals-text'), found.reason || (names.length ? '' : 'too many to be shown here: see the report'));
  by('report').hidden = Boolean(found.reason);
  names.forEach((name) => drawResiduals(name, found.fluoroscopes[name]));
}

function drawResiduals(name, {size, exposures: rows}) {
  const all = Object.values(rows).flat().filter((row) => row[4]);
  const lengths = all.map(([, , du, dv]) => Math.hypot(du, dv)).sort((a, b) => a - b);
  const large = lengths[Math.floor(0.95 * (lengths.length - 1))] || 1;
  const figure = document.createElement('figure');
  const canvas = document.createElement('canvas');
  const caption = document.createElement('figcaption');
  const factor = 640 / size[0];
  const zoom = ARROW_PX / (factor * large);
  canvas.width = 640;
  canvas.height = Math.round(factor * size[1]);
  canvas.setAttribute('role', 'img');
  caption.textContent = `${name}: ${all.length} residuals of ${Object.keys(rows).length} exposures, `
    + `drawn ${number(zoom, 0)} times as long; 95 % are shorter than ${number(large, 2)} px`;
  canvas.setAttribute('aria-label', caption.textContent);
  const pen = canvas.getContext('2d');
  pen.strokeStyle = BEAD;
  for (const [u, v, du, dv] of all) {
    pen.beginPath();
    pen.moveTo(factor * u, factor * v);
    pen.lineTo(factor * (u + zoom * du), factor * (v + zoom * dv));
    pen.stroke();
  }
  figure.append(canvas, caption);
  by('residuals').append(figure);
}

// Requests.

async function request(action) {
  const answer = await fetch(`/request/${action}`, {method: 'POST'});
  if (!answer.ok) put(by('sentence'), await answer.text());
}

function startControls() {
  startActions();
  startView();
}

function startActions() {
  document.querySelectorAll('[data-request]').forEach((button) => {
    button.addEventListener('click', () => request(button.dataset.request));
  });
  let asked = '';
  document.querySelectorAll('[data-confirm]').forEach((button) => {
    button.addEventListener('click', () => {
      asked = button.dataset.confirm;
      put(by('confirm-text'), CONFIRMATIONS[asked]);
      by('confirm').showModal();
    });
  });
  by('confirm').addEventListener('close', () => {
    if (by('confirm').returnValue === 'yes') request(asked);
    by('confirm').returnValue = '';
  });
  by('sound').addEventListener('click', () => {
    sound = sound ? null : new AudioContext();
    by('sound').setAttribute('aria-pressed', String(Boolean(sound)));
    put(by('sound'), `Sound: ${sound ? 'on' : 'off'}`);
  });
}

function startView() {
  const canvas = by('space');
  const turn = (across, up) => {
    camera.turn += across;
    camera.tilt = Math.max(-1.5, Math.min(1.5, camera.tilt + up));
    drawSpace();
  };
  canvas.addEventListener('pointermove', (event) => {
    if (event.buttons) turn(event.movementX / 150, event.movementY / 150);
  });
  const zoom = (factor) => {
    camera.zoom = Math.max(0.05, Math.min(20, camera.zoom * factor));
    drawSpace();
  };
  const keys = {
    ArrowLeft: () => turn(-0.1, 0),
    ArrowRight: () => turn(0.1, 0),
    ArrowUp: () => turn(0, -0.1),
    ArrowDown: () => turn(0, 0.1),
    '+': () => zoom(1.25),
    '-': () => zoom(0.8),
  };
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    zoom(event.deltaY < 0 ? 1.1 : 0.9);
  }, {passive: false});
  canvas.addEventListener('keydown', (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
}

async function update() {
  try {
    showState(await ask('/state'));
    if (!document.hidden) {
      const shown = [...views.keys()].flatMap((name) => [showRadiograph(name), showCoverage(name)]);
      await Promise.all([...shown, showSpace()]);
    }
  } catch (error) {
    by('light').className = 'light error';
    put(by('mark'), MARKS.error);
    put(by('word'), 'No connection');
    put(by('sentence'), error instanceof TypeError ? 'fluoro-calib watch has ended' : error.message);
  }
  setTimeout(update, PERIOD_MS);
}

startControls();
update();
