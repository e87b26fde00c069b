/* The interactive view of a report: one panel, or several that share a camera (vorolight compare).

   What it shows comes with the page: #scene is JSON that lists panels and their surfaces, and each
   surface's arrays are one deflated base64 block, #blob-PANEL-SURFACE, opened when it is first
   chosen. Nothing is fetched and nothing is evaluated. */
(() => {
  'use strict';

  const FIELD_OF_VIEW = 0.5; // radians, of the shorter side
  const BEGIN = 0.86; // an object seldom fills the ball around it
  const NEAREST = 0.05; // zoom limits, relative to the distance that shows everything
  const FARTHEST = 8;
  const MISSING = [150, 150, 150];
  const VERTEX = `#version 300 es
    in vec3 place; in vec3 normal; in vec3 colour; in vec3 away;
    uniform mat4 projection; uniform mat3 turn; uniform vec3 shift;
    uniform float dot_size; uniform float contrast;
    out vec3 shade; out vec3 inward;
    void main() {
      vec3 seen = turn * place + shift;
      vec3 n = turn * normal;
      float light = 1.0;
      if (dot(n, n) > 0.25) {
        n = normalize(n);
        if (dot(n, seen) > 0.0) n = -n;  // both sides of a face are lit
        light = 0.34 + 0.62 * max(dot(n, vec3(-0.36, 0.56, 0.746)), 0.0)
              + 0.14 * max(dot(n, vec3(0.8, -0.1, 0.59)), 0.0);
      }
      shade = colour * mix(1.0, light, contrast);
      inward = away;
      gl_Position = projection * vec4(seen, 1.0);
      gl_PointSize = dot_size;
    }`;
  /* Edges are where one of the three coordinates that grow inward from the sides is small, in
     pixels; a side that is no polygon's edge has a coordinate that stays at 1. */
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 shade; in vec3 inward;
    uniform float edge_width;
    out vec4 result;
    void main() {
      vec3 change = fwidth(inward);
      vec3 pixels = inward / max(change, vec3(1e-6));
      float nearest = min(min(pixels.x, pixels.y), pixels.z);
      float line = 0.6 * (1.0 - smoothstep(edge_width - 0.5, edge_width + 0.5, nearest));
      // Where faces are a few pixels small, lines would be all that is seen of them.
      vec3 heights = step(vec3(1e-5), change) / max(change, vec3(1e-5));
      line *= smoothstep(0.5, 5.0, max(max(heights.x, heights.y), heights.z) / edge_width * 0.5);
      result = vec4(mix(shade, vec3(0.06, 0.07, 0.11), edge_width > 0.0 ? line : 0.0), 1.0);
    }`;

  // ---- the page's data

  const TYPES = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, f4: Float32Array };

  /* The arrays of a surface; each begins at a multiple of four bytes. */
  async function unpack(id, arrays) {
    const text = atob(document.getElementById(id).textContent.trim());
    const packed = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
    const buffer = await new Response(stream).arrayBuffer();
    const found = {};
    let at = 0;
    for (const [name, type, length] of arrays) {
      found[name] = new TYPES[type](buffer, at, length);
      at = Math.ceil((at + found[name].byteLength) / 4) * 4;
    }
    return found;
  }

  /* Positions about the panel's centre, with its radius as 1. */
  function placed(arrays, surface, panel) {
    const { positions } = arrays;
    const result = new Float32Array(positions.length);
    for (let i = 0; i < positions.length; i++) {
      const axis = i % 3;
      const value = surface.low[axis] + positions[i] * surface.step;
      result[i] = (value - panel.centre[axis]) / panel.radius;
    }
    return result;
  }

  /* Offsets of the faces' corners from their counts. */
  function offsetsOf(arrays) {
    const count = arrays.valences ? arrays.valences.length : arrays.corners.length / 3;
    const offsets = new Uint32Array(count + 1);
    for (let f = 0; f < count; f++) {
      offsets[f + 1] = offsets[f] + (arrays.valences ? arrays.valences[f] : 3);
    }
    return offsets;
  }

  /* The sum of a face's corners, and its area vector (Newell) in `out`: x y z, nx ny nz. */
  function sumFace(points, corners, begin, end, out) {
    out.fill(0);
    for (let k = begin; k < end; k++) {
      const a = 3 * corners[k];
      const b = 3 * corners[k + 1 < end ? k + 1 : begin];
      for (let i = 0; i < 3; i++) {
        const j = (i + 1) % 3;
        const l = (i + 2) % 3;
        out[i] += points[a + i];
        out[3 + i] += (points[a + j] - points[b + j]) * (points[a + l] + points[b + l]);
      }
    }
  }

  /* Triangles with corners of their own, so that every polygon is shaded as one flat piece. Larger
     polygons are fanned about the mean of their corners. `source` says from which vertex a corner
     is, -1 for such a mean; `face` says of which face a triangle is; `away` is 0 on the polygon's
     edges, in one of three coordinates, and 1 on the lines of the fan. */
  function facets(points, corners, offsets) {
    const faces = offsets.length - 1;
    let total = 0;
    for (let f = 0; f < faces; f++) {
      const n = offsets[f + 1] - offsets[f];
      total += n === 3 ? 1 : n;
    }
    const place = new Float32Array(9 * total);
    const normal = new Int8Array(12 * total);
    const away = new Uint8Array(12 * total).fill(1);
    const source = new Int32Array(3 * total);
    const face = new Uint32Array(total);
    const sums = new Float64Array(6);
    let t = 0;
    const put = (corner, vertex, mean, whole) => {
      const at = 3 * t + corner;
      source[at] = vertex;
      if (whole) for (let i = 0; i < 3; i++) away[4 * at + i] = i === corner ? 1 : 0;
      else away[4 * at] = vertex < 0 ? 1 : 0;
      for (let i = 0; i < 3; i++) {
        place[3 * at + i] = vertex < 0 ? mean[i] : points[3 * vertex + i];
        normal[4 * at + i] = mean[3 + i];
      }
    };
    for (let f = 0; f < faces; f++) {
      const begin = offsets[f];
      const end = offsets[f + 1];
      const n = end - begin;
      sumFace(points, corners, begin, end, sums);
      const length = Math.hypot(sums[3], sums[4], sums[5]) || 1;
      for (let i = 0; i < 3; i++) {
        sums[i] /= n;
        sums[3 + i] *= 127 / length;
      }
      for (let k = begin; k < (n === 3 ? begin + 1 : end); k++, t++) {
        const next = k + 1 < end ? k + 1 : begin;
        face[t] = f;
        put(0, n === 3 ? corners[begin + 2] : -1, sums, n === 3);
        put(1, corners[k], sums, n === 3);
        put(2, corners[next], sums, n === 3);
      }
    }
    return { place, normal, away, source, face };
  }

  // ---- colours

  /* The table's colour at share t, 0 to 1, of the way. */
  function mapped(stops, t) {
    const x = Math.min(Math.max(t, 0), 1) * (stops.length - 1);
    const i = Math.min(Math.floor(x), stops.length - 2);
    return stops[i].map((low, c) => low + (x - i) * (stops[i + 1][c] - low));
  }

  function colourTable(stops) {
    const table = new Uint8Array(3 * 256);
    for (let i = 0; i < 256; i++) table.set(mapped(stops, i / 255).map(Math.round), 3 * i);
    return table;
  }

  function plainColours(model, surface) {
    const { face, tint } = model;
    const result = new Uint8Array(12 * face.length);
    for (let t = 0; t < face.length; t++) {
      const rgb = tint && tint[face[t]] ? surface.second : surface.colour;
      for (let i = 12 * t; i < 12 * t + 12; i += 4) {
        result[i] = rgb[0];
        result[i + 1] = rgb[1];
        result[i + 2] = rgb[2];
      }
    }
    return result;
  }

  /* One value for every corner; the mean of its face's corners where a face is fanned. */
  function cornerValues(model, field, perFace) {
    const { face, source, offsets, corners } = model;
    const values = new Float32Array(source.length);
    for (let i = 0; i < source.length; i++) {
      const f = face[(i / 3) | 0];
      if (perFace) {
        values[i] = field[f];
      } else if (source[i] >= 0) {
        values[i] = field[source[i]];
      } else {
        let sum = 0;
        for (let k = offsets[f]; k < offsets[f + 1]; k++) sum += field[corners[k]];
        values[i] = sum / (offsets[f + 1] - offsets[f]);
      }
    }
    return values;
  }

  function fieldColours(values, range, table) {
    const result = new Uint8Array(4 * values.length);
    const [low, high] = range;
    const scale = high > low ? 255 / (high - low) : 0;
    for (let i = 0; i < values.length; i++) {
      const t = 3 * ((i / 3) | 0);
      // A triangle with a corner of unknown value is grey as a whole.
      if (Number.isNaN(values[t] + values[t + 1] + values[t + 2])) {
        result.set(MISSING, 4 * i);
        continue;
      }
      const at = 3 * Math.round(Math.min(Math.max((values[i] - low) * scale, 0), 255));
      for (let c = 0; c < 3; c++) result[4 * i + c] = table[at + c];
    }
    return result;
  }

  // ---- drawing

  function program(gl) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    ['place', 'normal', 'colour', 'away'].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    const at = {};
    for (const name of ['projection', 'turn', 'shift', 'dot_size', 'contrast', 'edge_width']) {
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  function buffer(gl, data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  }

  /* Right, up and towards the viewer, as rows; the angles are those of the static pictures. */
  function frameOf(camera, panel) {
    const axis = panel.up;
    const azimuth = panel.turn + camera.azimuth;
    const towards = [0, 0, 0];
    towards[axis] = Math.sin(camera.elevation);
    towards[(axis + 1) % 3] = Math.cos(camera.elevation) * Math.cos(azimuth);
    towards[(axis + 2) % 3] = Math.cos(camera.elevation) * Math.sin(azimuth);
    const right = [0, 0, 0];
    right[(axis + 1) % 3] = -Math.sin(azimuth);
    right[(axis + 2) % 3] = Math.cos(azimuth);
    const up = [0, 1, 2].map((i) => {
      const j = (i + 1) % 3;
      const k = (i + 2) % 3;
      return towards[j] * right[k] - towards[k] * right[j];
    });
    return [right, up, towards];
  }

  /* A panel: its canvas, and the surfaces that were opened so far. */
  class Panel {
    constructor(element, scene, index) {
      this.element = element;
      this.scene = scene;
      this.index = index;
      this.data = scene.panels[index];
      this.canvas = element.querySelector('canvas.live');
      this.message = element.querySelector('.message');
      this.models = new Map();
      this.table = colourTable(scene.stops);
      this.current = null;
      this.open();
      this.canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
      this.canvas.addEventListener('webglcontextrestored', () => {
        this.models.clear();
        this.open();
        this.restored();
      });
    }

    open() {
      const options = { antialias: true, alpha: true, preserveDrawingBuffer: true };
      this.gl = this.canvas.getContext('webgl2', options);
      if (!this.gl) return;
      this.program = program(this.gl);
    }

    surface(key) {
      return this.data.surfaces.find((found) => found.key === key);
    }

    async model(key) {
      if (this.models.has(key)) return this.models.get(key);
      const surface = this.surface(key);
      const id = `blob-${this.index}-${this.data.surfaces.indexOf(surface)}`;
      const arrays = await unpack(id, surface.arrays);
      const points = placed(arrays, surface, this.data);
      const model = { arrays, tint: arrays.tint, count: points.length / 3 };
      const { gl } = this;
      if (arrays.corners) {
        const offsets = offsetsOf(arrays);
        Object.assign(model, facets(points, arrays.corners, offsets), { offsets });
        model.corners = arrays.corners;
        model.count = model.source.length;
        model.buffers = {
          place: buffer(gl, model.place),
          normal: buffer(gl, model.normal),
          away: buffer(gl, model.away),
        };
        model.place = model.normal = model.away = null; // the graphics memory has them
      } else {
        model.buffers = { place: buffer(gl, points) };
      }
      this.models.set(key, model);
      return model;
    }

    colour(model, surface, mode, range) {
      const { gl } = this;
      if (!model.face) return;
      const field = surface.fields[mode];
      const colours = field
        ? fieldColours(cornerValues(model, model.arrays[mode], field.per === 'face'), range, this.table)
        : plainColours(model, surface);
      if (model.buffers.colour) gl.deleteBuffer(model.buffers.colour);
      model.buffers.colour = buffer(gl, colours);
    }

    say(text) {
      this.message.textContent = text;
      this.message.hidden = !text;
    }

    /* Show a surface; false when there is none of that name. */
    async show(key, mode, range) {
      const surface = this.surface(key);
      if (!this.gl) return;
      if (!surface) {
        this.current = null;
        this.say(this.data.absent[key] || 'not run');
        return;
      }
      const asked = (this.asked = {});
      const model = await this.model(key);
      if (asked !== this.asked) return; // another one was chosen meanwhile
      this.colour(model, surface, mode, range);
      this.current = { model, surface, coloured: mode in surface.fields };
      this.say('');
    }

    resize() {
      const ratio = Math.min(window.devicePixelRatio || 1, 2);
      this.ratio = ratio;
      const width = Math.round(this.canvas.clientWidth * ratio);
      const height = Math.round(this.canvas.clientHeight * ratio);
      if (!width || !height) return; // hidden, as in print
      if (this.canvas.width !== width || this.canvas.height !== height) {
        this.canvas.width = width;
        this.canvas.height = height;
      }
    }

    draw(camera, edges) {
      const { gl } = this;
      if (!gl || gl.isContextLost()) return;
      this.resize();
      const { width, height } = this.canvas;
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      if (!this.current) return;
      this.place(camera, width, height);
      this.drawSurface(width, edges);
    }

    place(camera, width, height) {
      const { gl } = this;
      const { made, at } = this.program;
      const frame = frameOf(camera, this.data);
      const distance = camera.distance / Math.sin(FIELD_OF_VIEW / 2);
      const focus = 1 / Math.tan(FIELD_OF_VIEW / 2);
      const shorter = Math.min(width, height);
      const near = Math.max(distance - 1.5, 0.02);
      const far = distance + 3; // points may lie out
      gl.useProgram(made);
      gl.uniformMatrix4fv(at.projection, false, [
        focus * shorter / width, 0, 0, 0,
        0, focus * shorter / height, 0, 0,
        0, 0, (near + far) / (near - far), -1,
        0, 0, 2 * near * far / (near - far), 0,
      ]);
      gl.uniformMatrix3fv(at.turn, false, [0, 1, 2].flatMap((i) => frame.map((row) => row[i])));
      gl.uniform3f(at.shift, camera.pan[0], camera.pan[1], -distance);
    }

    drawSurface(width, edges) {
      const { gl } = this;
      const { model, surface, coloured } = this.current;
      const { at } = this.program;
      gl.enable(gl.DEPTH_TEST);
      gl.depthFunc(gl.LEQUAL);
      gl.uniform1f(at.dot_size, Math.max(1.5, width / 450));
      const outlined = edges && surface.edges && model.face;
      gl.uniform1f(at.edge_width, outlined ? 0.55 * this.ratio : 0);
      gl.uniform1f(at.contrast, coloured ? 0.45 : 1); // colours are to be read off the legend
      this.attribute(0, model.buffers.place, 3, gl.FLOAT, false, 0);
      this.attribute(1, model.buffers.normal, 3, gl.BYTE, true, 4);
      this.attribute(2, model.buffers.colour, 3, gl.UNSIGNED_BYTE, true, 4);
      this.attribute(3, model.buffers.away, 3, gl.UNSIGNED_BYTE, false, 4);
      if (!model.buffers.colour) gl.vertexAttrib3f(2, ...surface.colour.map((c) => c / 255));
      gl.drawArrays(model.face ? gl.TRIANGLES : gl.POINTS, 0, model.count);
    }

    attribute(index, data, size, type, normalised, stride) {
      const { gl } = this;
      if (!data) {
        gl.disableVertexAttribArray(index);
        gl.vertexAttrib3f(index, 0, 0, 0);
        return;
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, data);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, size, type, normalised, stride, 0);
    }

    /* What is seen now, on a canvas that prints everywhere. */
    copy() {
      const copy = this.element.querySelector('canvas.printed');
      copy.width = this.canvas.width;
      copy.height = this.canvas.height;
      copy.getContext('2d').drawImage(this.canvas, 0, 0);
    }
  }

  // ---- the view: panels, camera, controls

  /* A number to read, small and large ones with a power of ten. */
  function shown(value) {
    const size = Math.abs(value);
    if (size === 0 || (size >= 1e-3 && size < 1e6)) return String(Number(value.toPrecision(3)));
    const [mantissa, power] = value.toExponential(2).split('e');
    const raised = [...power.replace('+', '')].map((c) => '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'['-0123456789'.indexOf(c)]);
    return `${Number(mantissa)}·10${raised.join('')}`;
  }

  class View {
    constructor(root, scene) {
      this.root = root;
      this.scene = scene;
      this.state = { key: scene.first, mode: 'plain', edges: true, shared: false };
      this.reset();
      this.panels = [...root.querySelectorAll('.panel')].map(
        (element, index) => new Panel(element, scene, index),
      );
    }

    get works() {
      return this.panels.every((panel) => panel.gl);
    }

    reset() {
      const { elevation } = this.scene;
      this.camera = { azimuth: 0, elevation, distance: BEGIN, pan: [0, 0] };
    }

    /* The colours' range: of the surface shown, in all panels, or of all surfaces. */
    range() {
      const { key, mode, shared } = this.state;
      const fields = this.panels
        .flatMap((panel) => panel.data.surfaces)
        .filter((surface) => shared || surface.key === key)
        .map((surface) => surface.fields[mode])
        .filter(Boolean);
      if (!fields.length) return null;
      return [
        Math.min(...fields.map((field) => field.low)),
        Math.max(...fields.map((field) => field.high)),
      ];
    }

    async update() {
      const { key, mode } = this.state;
      const range = this.range();
      this.root.dataset.state = 'busy';
      try {
        await Promise.all(this.panels.map((panel) => panel.show(key, mode, range)));
      } catch (error) {
        this.fail(`The view cannot be drawn (${error.message}).`);
        return;
      }
      this.legend(range);
      this.draw();
      this.root.dataset.state = 'ready';
      this.root.dataset.milliseconds ||= Math.round(performance.now());
    }

    draw() {
      if (this.waiting) return;
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        for (const panel of this.panels) panel.draw(this.camera, this.state.edges);
      });
    }

    fail(text) {
      this.root.dataset.state = 'failed';
      this.root.classList.add('failed');
      const note = this.root.querySelector('.failure');
      note.textContent = text;
      note.hidden = false;
    }

    legend(range) {
      const { key, mode } = this.state;
      const box = this.root.querySelector('.legend');
      const about = this.scene.modes.find((found) => found.key === mode);
      box.hidden = mode === 'plain' || !range;
      if (!box.hidden) {
        const numbers = [0, 0.25, 0.5, 0.75, 1].map((t) => range[0] + t * (range[1] - range[0]));
        box.querySelector('.title').textContent = about.title + (about.unit ? `, ${about.unit}` : '');
        box.querySelector('.scale').replaceChildren(...numbers.map((value, i) => {
          const label = document.createElement('span');
          label.textContent = (i === 0 ? '\u2264 ' : i === 4 ? '\u2265 ' : '') + shown(value);
          return label;
        }));
        this.ramp(box.querySelector('canvas'));
      }
      const notes = this.panels.flatMap((panel) => {
        const surface = panel.surface(key);
        if (!surface) return [];
        const why = mode === 'plain' ? '' : surface.missing[mode];
        const name = this.panels.length > 1 ? `${panel.data.name}: ` : '';
        return [why, surface.note].filter(Boolean).map((text) => name + text);
      });
      this.root.querySelector('.note').textContent = notes.join(' ');
    }

    ramp(canvas) {
      const table = colourTable(this.scene.stops);
      const context = canvas.getContext('2d');
      const image = context.createImageData(256, 1);
      for (let i = 0; i < 256; i++) {
        image.data.set([table[3 * i], table[3 * i + 1], table[3 * i + 2], 255], 4 * i);
      }
      context.putImageData(image, 0, 0);
    }

    // -- what the user does

    rotate(right, up) {
      const limit = Math.PI / 2 - 1e-3;
      this.camera.azimuth -= right;
      this.camera.elevation = Math.min(Math.max(this.camera.elevation + up, -limit), limit);
      this.draw();
    }

    /* Move the picture by shares of the canvas' shorter side. */
    pan(right, up) {
      const span = 2 * this.camera.distance / Math.cos(FIELD_OF_VIEW / 2);
      this.camera.pan[0] += right * span;
      this.camera.pan[1] += up * span;
      this.draw();
    }

    zoom(factor) {
      const { camera } = this;
      camera.distance = Math.min(Math.max(camera.distance * factor, NEAREST), FARTHEST);
      this.draw();
    }

    key(event) {
      const arrow = {
        ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1],
      }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (arrow && event.shiftKey) this.pan(0.05 * arrow[0], 0.05 * arrow[1]);
      else if (arrow) this.rotate(0.1 * arrow[0], 0.1 * -arrow[1]);
      else if (event.key === '+' || event.key === '=') this.zoom(1 / 1.15);
      else if (event.key === '-' || event.key === '_') this.zoom(1.15);
      else if (event.key === '0' || event.key === 'Home') { this.reset(); this.draw(); }
      else if (event.key === 'w') this.root.querySelector('.edges').click();
      else return;
      event.preventDefault();
    }

    listenTo(canvas) {
      const fingers = new Map();
      const middle = () => {
        const all = [...fingers.values()];
        return {
          x: all.reduce((sum, f) => sum + f.x, 0) / all.length,
          y: all.reduce((sum, f) => sum + f.y, 0) / all.length,
          spread: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0,
        };
      };
      canvas.addEventListener('pointerdown', (event) => {
        canvas.setPointerCapture(event.pointerId);
        fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      });
      canvas.addEventListener('pointermove', (event) => {
        if (!fingers.has(event.pointerId)) return;
        const before = middle();
        fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        const after = middle();
        const size = Math.min(canvas.clientWidth, canvas.clientHeight);
        const [x, y] = [(after.x - before.x) / size, (after.y - before.y) / size];
        if (fingers.size > 1) {
          this.pan(x, -y);
          if (before.spread && after.spread) this.zoom(before.spread / after.spread);
        } else if (event.shiftKey || event.buttons & 6) {
          this.pan(x, -y);
        } else {
          this.rotate(Math.PI * x, Math.PI * y);
        }
      });
      const lift = (event) => fingers.delete(event.pointerId);
      canvas.addEventListener('pointerup', lift);
      canvas.addEventListener('pointercancel', lift);
      canvas.addEventListener('contextmenu', (event) => event.preventDefault());
      canvas.addEventListener('keydown', (event) => this.key(event));
      canvas.addEventListener('wheel', (event) => {
        event.preventDefault();
        const lines = event.deltaMode === 1 ? 20 : 1;
        this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY * lines)) * 0.003));
      }, { passive: false });
    }

    control(selector, kind, action) {
      for (const element of this.root.querySelectorAll(selector)) {
        element.addEventListener(kind, () => action(element));
      }
    }

    start() {
      const { state } = this;
      this.control('input.surface', 'change', (box) => { state.key = box.value; this.update(); });
      this.control('.mode', 'change', (box) => { state.mode = box.value; this.update(); });
      this.control('.edges', 'change', (box) => { state.edges = box.checked; this.draw(); });
      this.control('.shared', 'change', (box) => { state.shared = box.checked; this.update(); });
      this.control('.closer', 'click', () => this.zoom(1 / 1.25));
      this.control('.farther', 'click', () => this.zoom(1.25));
      this.control('.reset', 'click', () => { this.reset(); this.draw(); });
      const observer = new ResizeObserver(() => this.draw());
      for (const panel of this.panels) {
        this.listenTo(panel.canvas);
        observer.observe(panel.canvas);
        panel.restored = () => this.update();
      }
      const copy = () => this.panels.forEach((panel) => panel.copy());
      window.addEventListener('beforeprint', copy);
      window.matchMedia('print').addEventListener('change', (event) => event.matches && copy());
      // A browser keeps what was chosen when a page is loaded again; the view begins anew.
      this.root.querySelector('form').reset();
      this.root.querySelector('.controls').hidden = false;
      return this.update();
    }
  }

  const root = document.querySelector('.viewer');
  const scene = JSON.parse(document.getElementById('scene').textContent);
  const view = new View(root, scene);
  if (!view.works) {
    view.fail('This browser has no WebGL 2, which the view needs; the pictures below show the same.');
  } else if (typeof DecompressionStream === 'undefined') {
    view.fail('This browser is too old for the view; the pictures below show the same.');
  } else {
    view.start();
  }
})();
