// The painter of flx. Texels hold a number each, their label; the picture shows these numbers as they will be saved.
"use strict";
(async () => {
  const at = (id) => document.getElementById(id);
  const stage = at("stage"), canvas = at("canvas");
  const UNDO_BYTES = 2 ** 28, OVERLAYS = { keep: ["#000000", "#12a37a"] };

  function say(line, fault = false) {
    at("status").textContent = line;
    at("status").classList.toggle("fault", fault);
  }

  // --- what the server knows

  async function ask(name, body) {
    let answer;
    try {
      answer = await fetch(name, body === undefined ? {} : { method: "POST", body });
    } catch {
      throw new Error("flx does not answer; is it still running?");
    }
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  }

  async function inflated(blob) {
    return new Response(blob.stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  }

  const bytes = (text) => inflated(new Blob([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))]));

  async function packed(array) {
    const blob = await new Response(new Blob([array]).stream().pipeThrough(new CompressionStream("deflate"))).blob();
    return new Promise((done, failed) => {
      const reader = new FileReader();
      reader.onload = () => done(reader.result.slice(reader.result.indexOf(",") + 1));
      reader.onerror = () => failed(reader.error);
      reader.readAsDataURL(blob);
    });
  }

  const data = await (await ask("data")).json();
  const isTexels = data.mode !== "direction";
  const load = async (name, kind) => (data[name] === undefined ? null : new kind(await bytes(data[name])));
  const positions = await load("positions", Float32Array), normals = await load("normals", Int8Array);
  const uvs = await load("uvs", Float64Array), colors = await load("colors", Uint8Array);
  const places = await load("places", Int32Array), across = await load("across", Int32Array);
  const charts = await load("charts", Int32Array), parts = await load("parts", Int32Array);
  const faces = positions.length / 9, { width, height } = data;
  const ids = await load("numbers", Uint8Array), owners = await load("owners", Int32Array);
  const followers = await load("followers", Int32Array), paintable = await load("paintable", Uint8Array);

  // --- the brush grows over the surface: faces around a point are unfolded into its plane, nearest first

  const flat = new Float64Array(6 * faces); // corners of each face in that plane, the point at 0
  const seen = new Int32Array(faces);
  let round = 0;
  const heap = { keys: [], corners: [] };

  function push(key, corner) {
    const { keys, corners } = heap;
    let k = keys.length;
    while (k > 0) {
      const above = (k - 1) >> 1;
      if (keys[above] <= key) break;
      keys[k] = keys[above];
      corners[k] = corners[above];
      k = above;
    }
    keys[k] = key;
    corners[k] = corner;
  }

  function pop() {
    const { keys, corners } = heap, first = corners[0], key = keys.pop(), corner = corners.pop();
    const count = keys.length;
    let k = 0;
    while (count) {
      let below = 2 * k + 1;
      if (below >= count) break;
      if (below + 1 < count && keys[below + 1] < keys[below]) below++;
      if (keys[below] >= key) break;
      keys[k] = keys[below];
      corners[k] = corners[below];
      k = below;
    }
    if (count) [keys[k], corners[k]] = [key, corner];
    return first;
  }

  const turned = (corner, steps) => corner - (corner % 3) + ((corner + steps) % 3);

  function edges(face, radius) { // those that the brush reaches, but for the ones that it came over
    for (let corner = 3 * face; corner < 3 * face + 3; corner++) {
      const there = across[corner];
      if (there < 0 || seen[(there / 3) | 0] === round) continue;
      const a = 2 * turned(corner, 1), b = 2 * turned(corner, 2);
      const ax = flat[a], ay = flat[a + 1], dx = flat[b] - ax, dy = flat[b + 1] - ay;
      const share = Math.max(0, Math.min(1, -(ax * dx + ay * dy) / (dx * dx + dy * dy || 1)));
      const away = Math.hypot(ax + share * dx, ay + share * dy);
      if (away <= radius) push(away, corner);
    }
  }

  function lay(face, point) { // the face of the point itself
    const p = 9 * face, [x, y, z] = point;
    const e = [0, 1, 2].map((k) => positions[p + 3 + k] - positions[p + k]);
    const d = [0, 1, 2].map((k) => positions[p + 6 + k] - positions[p + k]);
    const length = Math.hypot(...e) || 1, right = e.map((one) => one / length);
    const along = d[0] * right[0] + d[1] * right[1] + d[2] * right[2];
    const up = d.map((one, k) => one - along * right[k]), tall = Math.hypot(...up) || 1;
    for (let c = 0; c < 3; c++) {
      const q = [positions[p + 3 * c] - x, positions[p + 3 * c + 1] - y, positions[p + 3 * c + 2] - z];
      flat[6 * face + 2 * c] = q[0] * right[0] + q[1] * right[1] + q[2] * right[2];
      flat[6 * face + 2 * c + 1] = (q[0] * up[0] + q[1] * up[1] + q[2] * up[2]) / tall;
    }
  }

  function unfold(corner) { // the face across the edge opposite to a corner; returns it
    const a = turned(corner, 1), b = turned(corner, 2), third = across[corner];
    let one = turned(third, 1), other = turned(third, 2);
    if (places[one] !== places[a]) [one, other] = [other, one];
    const p = 3 * one, q = 3 * other, r = 3 * third;
    const bx = positions[q] - positions[p], by = positions[q + 1] - positions[p + 1], bz = positions[q + 2] - positions[p + 2];
    const cx = positions[r] - positions[p], cy = positions[r + 1] - positions[p + 1], cz = positions[r + 2] - positions[p + 2];
    const square = bx * bx + by * by + bz * bz || 1e-30, share = (bx * cx + by * cy + bz * cz) / square;
    const tall = Math.sqrt(Math.max(0, cx * cx + cy * cy + cz * cz - share * share * square));
    const ax = flat[2 * a], ay = flat[2 * a + 1], dx = flat[2 * b] - ax, dy = flat[2 * b + 1] - ay;
    const side = dx * (flat[2 * corner + 1] - ay) - dy * (flat[2 * corner] - ax) > 0 ? -1 : 1;
    const lift = (side * tall) / (Math.hypot(dx, dy) || 1);
    flat[2 * one] = ax;
    flat[2 * one + 1] = ay;
    flat[2 * other] = ax + dx;
    flat[2 * other + 1] = ay + dy;
    flat[2 * third] = ax + share * dx - lift * dy;
    flat[2 * third + 1] = ay + share * dy + lift * dx;
    return (third / 3) | 0;
  }

  function grow(start, point, radius, visit) {
    round++;
    heap.keys.length = heap.corners.length = 0;
    seen[start] = round;
    lay(start, point);
    visit(start);
    edges(start, radius);
    while (heap.keys.length) {
      const corner = pop();
      if (seen[(across[corner] / 3) | 0] === round) continue;
      const face = unfold(corner);
      seen[face] = round;
      visit(face);
      edges(face, radius);
    }
  }

  // --- texels

  let changed = { texels: new Int32Array(1 << 16), before: new Uint8Array(1 << 16), count: 0 };
  let stale = true; // whether the picture lags behind the texels

  function put(texel, value) {
    ids[texel] = value;
    for (let next = followers[texel]; next >= 0; next = followers[next]) ids[next] = value;
  }

  function set(texel, value) {
    const before = ids[texel];
    if (before === value) return;
    if (changed.count === changed.texels.length) {
      for (const name of ["texels", "before"]) {
        const larger = new changed[name].constructor(2 * changed.count);
        larger.set(changed[name]);
        changed[name] = larger;
      }
    }
    changed.texels[changed.count] = texel;
    changed.before[changed.count++] = before;
    put(texel, value);
    stale = true;
  }

  const wrapped = (n, size) => ((n % size) + size) % size;

  function fill(face, value, radius = Infinity) { // texels of a face, as far as the brush reaches
    if (!paintable[face]) return;
    const u = 6 * face;
    const x0 = uvs[u] * width - 0.5, y0 = uvs[u + 1] * height - 0.5;
    const x1 = uvs[u + 2] * width - 0.5 - x0, y1 = uvs[u + 3] * height - 0.5 - y0;
    const x2 = uvs[u + 4] * width - 0.5 - x0, y2 = uvs[u + 5] * height - 0.5 - y0;
    const area = x1 * y2 - x2 * y1, tiny = Math.abs(area) < 1e-9;
    let left = Math.min(0, x1, x2), right = Math.max(0, x1, x2), top = Math.min(0, y1, y2), bottom = Math.max(0, y1, y2);
    const ax = flat[u], ay = flat[u + 1], bx = flat[u + 2] - ax, by = flat[u + 3] - ay, cx = flat[u + 4] - ax, cy = flat[u + 5] - ay;
    const whole = radius === Infinity || Math.max(Math.hypot(ax, ay), Math.hypot(ax + bx, ay + by), Math.hypot(ax + cx, ay + cy)) <= radius;
    const turn = bx * cy - by * cx;
    if (!whole && Math.abs(turn) > 1e-18) { // the box around the disc, on the atlas
      const xx = (x1 * cy - x2 * by) / turn, xy = (x2 * bx - x1 * cx) / turn;
      const yx = (y1 * cy - y2 * by) / turn, yy = (y2 * bx - y1 * cx) / turn;
      const x = -xx * ax - xy * ay, y = -yx * ax - yy * ay, dx = radius * Math.hypot(xx, xy), dy = radius * Math.hypot(yx, yy);
      [left, right, top, bottom] = [Math.max(left, x - dx), Math.min(right, x + dx), Math.max(top, y - dy), Math.min(bottom, y + dy)];
    }
    const reach = radius * radius;
    for (let y = Math.ceil(y0 + top - 0.5); y <= y0 + bottom + 0.5; y++) {
      const row = wrapped(y, height) * width, down = y - y0;
      for (let x = Math.ceil(x0 + left - 0.5); x <= x0 + right + 0.5; x++) {
        const texel = row + wrapped(x, width), along = x - x0;
        let w1 = (along * y2 - x2 * down) / area, w2 = (x1 * down - along * y1) / area;
        const inside = !tiny && w1 >= -1e-6 && w2 >= -1e-6 && w1 + w2 <= 1 + 1e-6;
        if (!inside && owners[texel] !== face) continue; // a small face owns texels whose centres it misses
        if (tiny) w1 = w2 = 1 / 3;
        const px = ax + w1 * bx + w2 * cx, py = ay + w1 * by + w2 * cy;
        if (whole || px * px + py * py <= reach) set(texel, value);
      }
    }
  }

  // --- undo and redo: an entry is undone and redone by the same exchange

  const past = [], future = [];
  let unsaved = false;

  function note(entry) {
    past.push(entry);
    future.length = 0;
    let sum = past.reduce((total, one) => total + one.bytes, 0);
    while (sum > UNDO_BYTES && past.length > 1) sum -= past.shift().bytes;
    unsaved = true;
    buttons();
  }

  function noteTexels() {
    const { texels, before, count } = changed;
    if (!count) return;
    changed.count = 0;
    const entry = { texels: texels.slice(0, count), values: before.slice(0, count), bytes: 5 * count };
    entry.exchange = () => {
      for (let k = 0; k < count; k++) {
        const now = ids[entry.texels[k]];
        put(entry.texels[k], entry.values[k]);
        entry.values[k] = now;
      }
      stale = true;
    };
    note(entry);
  }

  function takeBack() { // what the stroke that is under way has painted
    for (let k = changed.count - 1; k >= 0; k--) put(changed.texels[k], changed.before[k]);
    changed.count = 0;
    stale = true;
    if (pen && pen.before) strokes = pen.before;
    pen = null;
    showStrokes();
    draw();
  }

  function step(from, to, word) {
    const entry = from.pop();
    if (!entry) return say(`There is nothing to ${word}.`);
    entry.exchange();
    to.push(entry);
    unsaved = true;
    say(word === "undo" ? "Undone." : "Done again.");
    buttons();
    draw();
  }

  const undo = () => (pen ? takeBack() : step(past, future, "undo"));
  const redo = () => step(future, past, "redo");

  function buttons() {
    at("undo").disabled = !past.length;
    at("redo").disabled = !future.length;
  }

  // --- the picture

  const VERTEX = `
    varying vec3 normalHere, towards, here;
    varying vec2 place;
    varying vec3 painted;
    void main() {
      vec4 viewed = modelViewMatrix * vec4(position, 1.0);
      normalHere = normalMatrix * normal;
      towards = -viewed.xyz;
      here = position;
      #ifdef USE_COLOR
        painted = color;
      #else
        place = uv;
      #endif
      gl_Position = projectionMatrix * viewed;
    }`;
  const FRAGMENT = `
    varying vec3 normalHere, towards, here;
    varying vec2 place;
    varying vec3 painted;
    uniform sampler2D colors, numbers, palette;
    uniform float opacity, unlit, canPaint;
    uniform vec4 brushes[2];
    vec3 toLinear(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
    void main() {
      #ifdef USE_COLOR
        vec3 base = toLinear(painted);
      #else
        vec3 base = texture2D(colors, place).rgb;
        if (canPaint > 0.5) {
          int number = int(texture2D(numbers, place).r * 255.0 + 0.5);
          vec4 paint = texelFetch(palette, ivec2(number, 0), 0);
          base = mix(base, toLinear(paint.rgb), paint.a * opacity);
        }
      #endif
      vec3 n = normalize(normalHere), eye = normalize(towards), key = normalize(vec3(-0.35, 0.5, 0.8));
      vec3 sky = (viewMatrix * vec4(0.0, 1.0, 0.0, 0.0)).xyz;
      if (dot(n, eye) < 0.0) n = -n;
      float soft = clamp((dot(n, key) + 0.25) / 1.25, 0.0, 1.0);
      vec3 lit = base * (0.30 + 0.08 * (dot(n, sky) + 1.0) + 0.58 * soft);
      vec3 result = mix(lit, base, unlit);
      for (int k = 0; k < 2; k++) {
        float away = distance(here, brushes[k].xyz), pixel = fwidth(away);
        if (brushes[k].w > 0.0 && abs(away - brushes[k].w) < 2.0 * pixel)
          result = vec3(abs(away - brushes[k].w) < pixel ? 1.0 : 0.0);
      }
      gl_FragColor = vec4(result, 1.0);
      #include <colorspace_fragment>
    }`;

  function isSoftware() { // without a graphics card, smooth outlines take more than half of the time
    const gl = document.createElement("canvas").getContext("webgl2"), known = gl.getExtension("WEBGL_debug_renderer_info");
    const name = gl.getParameter(known ? known.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  }

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: !isSoftware(), preserveDrawingBuffer: true });
  } catch {
    throw new Error("there is no WebGL in this browser");
  }
  const eye = new THREE.PerspectiveCamera(), scene = new THREE.Scene(), root = new THREE.Group();
  const geometry = new THREE.BufferGeometry(), shared = {
    opacity: { value: 0.7 }, unlit: { value: 0 }, numbers: { value: null }, palette: { value: null },
    brushes: { value: [new THREE.Vector4(), new THREE.Vector4()] },
  };
  const solid = new THREE.BufferGeometry();
  solid.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  const tree = new BVH.MeshBVH(solid, { indirect: true }); // it keeps the order of the faces
  const rows = await load("rows", Uint32Array), firsts = await load("firsts", Uint32Array);
  const attributes = { position: [positions, 3], normal: [normals, 3], uv: [uvs && Float32Array.from(uvs), 2], color: [colors, 3] };
  for (const [name, [values, count]] of Object.entries(attributes)) { // of corners that differ, once each
    if (!values) continue;
    const some = new values.constructor(count * firsts.length);
    firsts.forEach((corner, row) => some.set(values.subarray(count * corner, count * corner + count), count * row));
    geometry.setAttribute(name, new THREE.BufferAttribute(some, count, name === "normal" || name === "color"));
  }
  geometry.setIndex(new THREE.BufferAttribute(rows, 1));
  scene.add(root);
  if (data.up === "z") root.rotation.x = -Math.PI / 2;
  root.updateMatrixWorld(true);

  if (isTexels) {
    const texture = new THREE.DataTexture(ids, width, height, THREE.RedFormat);
    const palette = new THREE.DataTexture(new Uint8Array(4 * 256), 256, 1);
    texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
    texture.unpackAlignment = 1;
    for (const one of [texture, palette]) one.magFilter = one.minFilter = THREE.NearestFilter;
    [shared.numbers.value, shared.palette.value] = [texture, palette];
  }

  async function picture(address) {
    const image = new Image(), made = new THREE.Texture(image);
    image.src = address;
    await image.decode();
    made.flipY = false;
    made.wrapS = made.wrapT = THREE.RepeatWrapping;
    made.anisotropy = 4;
    made.colorSpace = THREE.SRGBColorSpace;
    made.needsUpdate = true;
    return made;
  }

  const materials = [];
  for (let image = 0; image < Math.max(1, data.pictures.length); image++) {
    const first = data.groups.find((group) => group.image === image);
    materials.push(new THREE.ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide, vertexColors: Boolean(colors),
      uniforms: {
        ...shared,
        colors: { value: colors ? null : await picture(data.pictures[image]) },
        canPaint: { value: isTexels && first && paintable[first.start] ? 1 : 0 },
      },
    }));
  }
  const groups = data.groups.map(({ image, start, count }) => { // each with the ball that it lies in
    const box = new THREE.Box3(), corner = new THREE.Vector3();
    for (let c = 9 * start; c < 9 * (start + count); c += 3) box.expandByPoint(corner.fromArray(positions, c));
    const middle = box.getCenter(new THREE.Vector3());
    return { start: 3 * start, count: 3 * count, materialIndex: image, middle, radius: box.max.distanceTo(middle) };
  });
  const body = new THREE.Mesh(geometry, materials);
  body.frustumCulled = false;
  root.add(body);

  const camera = turntable(canvas, () => draw()), { reset } = camera;
  let drawing = false, dirty = []; // dirty: the boxes of the picture to draw again; null for all of it

  function aim() {
    camera.aim(eye, stage.clientWidth, stage.clientHeight);
    eye.updateMatrixWorld(true);
  }

  function drawNow() {
    drawing = false;
    const { clientWidth: wide, clientHeight: tall } = stage, ratio = Math.min(devicePixelRatio || 1, 2);
    if (!wide || !tall) return;
    if (renderer.getPixelRatio() !== ratio) renderer.setPixelRatio(ratio);
    if (canvas.width !== Math.floor(wide * ratio) || canvas.height !== Math.floor(tall * ratio)) {
      renderer.setSize(wide, tall, false);
      dirty = null;
    }
    aim();
    if (stale && isTexels) shared.numbers.value.needsUpdate = true;
    stale = false;
    renderer.setScissorTest(dirty !== null);
    if (dirty) { // a part of the picture takes a part of the time
      const [left, top] = [0, 1].map((k) => Math.max(0, Math.floor(Math.min(...dirty.map((box) => box[k])))));
      const [right, bottom] = [2, 3].map((k) => Math.ceil(Math.max(...dirty.map((box) => box[k]))));
      renderer.setScissor(left, tall - Math.min(bottom, tall), Math.max(0, Math.min(right, wide) - left), Math.max(0, Math.min(bottom, tall) - top));
      geometry.groups = groups.filter(({ middle, radius }) => {
        const [x, y, pixel] = onScreen(middle), reach = radius / pixel + 2;
        return !(pixel > 0) || (x + reach > left && x - reach < right && y + reach > top && y - reach < bottom);
      });
    } else geometry.groups = groups;
    dirty = [];
    renderer.render(scene, eye);
  }

  function draw(boxes = null) {
    dirty = dirty && boxes && [...dirty, ...boxes];
    if (drawing) return;
    drawing = true;
    requestAnimationFrame(drawNow);
  }

  function around(hit) { // the box of the picture that a brush at this place may reach
    const [x, y] = onScreen(new THREE.Vector3(...hit.point)), reach = 1.3 * size + 8;
    return [x - reach, y - reach, x + reach, y + reach];
  }

  const seenFrom = new THREE.Vector3();

  function onScreen(place) { // its CSS pixel, and the length of one there; not above 0 beside the camera
    const depth = -seenFrom.copy(place).applyMatrix4(root.matrixWorld).applyMatrix4(eye.matrixWorldInverse).z;
    seenFrom.applyMatrix4(eye.projectionMatrix);
    const pixel = (2 * depth * Math.tan((eye.fov * Math.PI) / 360)) / stage.clientHeight;
    return [((seenFrom.x + 1) / 2) * stage.clientWidth, ((1 - seenFrom.y) / 2) * stage.clientHeight, pixel];
  }

  function colorScheme() {
    renderer.setClearColor(getComputedStyle(document.documentElement).getPropertyValue("--stage").trim());
    draw();
  }

  // --- what is under the pointer, and under its mirror image

  const back = new THREE.Matrix4().copy(root.matrixWorld).invert();

  function hits(x, y) { // in CSS pixels of the picture
    const wide = stage.clientWidth, tall = stage.clientHeight;
    const ray = new THREE.Ray(), found = [];
    ray.origin.setFromMatrixPosition(eye.matrixWorld);
    ray.direction.set((2 * x) / wide - 1, 1 - (2 * y) / tall, 0.5).unproject(eye).sub(ray.origin).normalize();
    ray.applyMatrix4(back);
    const facing = eye.getWorldDirection(new THREE.Vector3()).transformDirection(back);
    for (const mirrored of mirror === null ? [false] : [false, true]) {
      for (const vector of mirrored ? [ray.origin, ray.direction, facing] : [])
        vector.setComponent(mirror, -vector.getComponent(mirror));
      const hit = tree.raycastFirst(ray, THREE.DoubleSide);
      if (!hit && !mirrored) return [];
      if (!hit) continue;
      const depth = hit.point.clone().sub(ray.origin).dot(facing);
      const pixel = (2 * depth * Math.tan((eye.fov * Math.PI) / 360)) / tall; // its length on the surface
      found.push({ point: hit.point.toArray(), face: hit.faceIndex, pixel, mirrored });
    }
    return found;
  }

  // --- tools

  let tool = "brush", label = Math.min(1, data.labels.length - 1), mirror = null, size = 24;
  let labels = data.labels, strokes = [], pen = null;
  const painting = () => (tool === "erase" ? 0 : label);

  function dab(hit) {
    if (isTexels) grow(hit.face, hit.point, size * hit.pixel, (face) => fill(face, painting(), size * hit.pixel));
    else if (tool === "erase") {
      const near = (p) => Math.hypot(...p.map((c, k) => c - hit.point[k])) <= size * hit.pixel;
      const left = strokes.filter((stroke) => !stroke.places.some(near));
      if (left.length === strokes.length) return;
      strokes = left;
      showStrokes();
    } else lengthen(hit);
    draw(isTexels && !data.notes.length ? [around(hit)] : null); // where texels are shared, paint shows elsewhere too
  }

  function fillAll(group, hit) {
    for (let face = 0; face < faces; face++) if (group[face] === group[hit.face]) fill(face, label);
  }

  function texelAt({ face, point }) {
    lay(face, point);
    const [ax, ay, bx, by, cx, cy] = flat.subarray(6 * face, 6 * face + 6);
    const turn = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) || 1;
    const w = [bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx].map((one) => one / turn);
    const [u, v] = [0, 1].map((k) => w.reduce((sum, one, c) => sum + one * uvs[6 * face + 2 * c + k], 0));
    return wrapped(Math.floor(v * height), height) * width + wrapped(Math.floor(u * width), width);
  }

  async function fillSimilar(found) {
    const value = label;
    say("Looking for like colours …");
    for (const hit of found) {
      if (!paintable[hit.face]) continue;
      const answer = await ask("similar", JSON.stringify({ texel: texelAt(hit), tolerance: Number(at("tolerance").value) / 100 }));
      const bits = new Uint8Array(await inflated(await answer.blob()));
      for (let k = 0; k < bits.length; k++)
        if (bits[k]) for (let bit = 0; bit < 8; bit++) if (bits[k] & (128 >> bit)) set(8 * k + bit, value);
    }
    say(`Filled ${changed.count.toLocaleString("en")} texels.`);
    noteTexels();
    draw();
  }

  async function begin(x, y, found) {
    if (tool === "similar") return fillSimilar(found).catch((fault) => say(fault.message, true));
    if (tool === "chart" || tool === "part") {
      for (const hit of found) fillAll(tool === "chart" ? charts : parts, hit);
      say(`Filled ${changed.count.toLocaleString("en")} texels.`);
      noteTexels();
      return draw();
    }
    pen = { x, y, pixel: found[0].pixel, before: isTexels ? null : strokes.slice(), lines: [null, null] };
    found.forEach(dab);
  }

  function go(x, y) { // dabs along the way of the pointer, close enough to look like one
    const gap = Math.max(1.5, isTexels || tool === "erase" ? size / 4 : 4);
    const steps = Math.floor(Math.hypot(x - pen.x, y - pen.y) / gap);
    if (!steps) return;
    const { x: fromX, y: fromY } = pen;
    for (let k = 1; k <= steps; k++) {
      const share = (k * gap) / Math.hypot(x - fromX, y - fromY);
      pen.x = fromX + share * (x - fromX);
      pen.y = fromY + share * (y - fromY);
      const found = hits(pen.x, pen.y);
      if (!found.length) pen.lines = [null, null];
      found.forEach(dab);
    }
  }

  function end() {
    if (!pen) return;
    const { before } = pen;
    pen = null;
    if (isTexels) return noteTexels();
    strokes = strokes.filter((stroke) => stroke.direction || stroke.places.length > 1);
    showStrokes();
    if (strokes.length === before.length && strokes.every((one, k) => one === before[k])) return;
    const entry = { strokes: before, bytes: 1000 };
    entry.exchange = () => {
      [strokes, entry.strokes] = [entry.strokes, strokes];
      showStrokes();
    };
    note(entry);
    say(counted());
  }

  // --- strokes: lines along which the texture shall run

  const RIBBON = 0.006, APART = 0.01; // in half diagonals of the mesh
  const toFile = (place) => place.map((c, k) => c * data.scale + data.offset[k]);
  const toPage = (point) => point.map((c, k) => (c - data.offset[k]) / data.scale);
  const counted = () => `${strokes.length} strokes, ${strokes.reduce((sum, one) => sum + one.points.length, 0).toLocaleString("en")} of 10,000 points.`;

  function normalAt(face, place) {
    const p = 9 * face, sum = [0, 1, 2].map((k) => normals[p + k] + normals[p + 3 + k] + normals[p + 6 + k]);
    const length = Math.hypot(...sum) || 1;
    return sum.map((one) => one / length);
  }

  function lengthen(hit) {
    const which = hit.mirrored ? 1 : 0, line = pen.lines[which], last = line && line.places[line.places.length - 1];
    const away = last ? Math.hypot(...last.map((c, k) => c - hit.point[k])) : 0;
    if (last && away < APART) return;
    if (last && away < Math.max(0.1, 20 * hit.pixel)) {
      line.places.push(hit.point);
      line.points.push(toFile(hit.point));
      line.faces.push(hit.face);
    } else { // it jumped to another part of the surface
      pen.lines[which] = { places: [hit.point], points: [toFile(hit.point)], faces: [hit.face] };
      strokes = [...strokes, pen.lines[which]];
    }
    showStrokes();
  }

  const ribbons = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.ShaderMaterial({
    side: THREE.DoubleSide,
    vertexShader: "void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); gl_Position.z -= 0.0015 * gl_Position.w; }",
    fragmentShader: "void main() { gl_FragColor = vec4(0.83, 0.0, 0.43, 1.0); }",
  }));
  ribbons.frustumCulled = false;
  root.add(ribbons);

  function showStrokes() {
    if (isTexels) return;
    const corners = [];
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const plus = (a, s, b) => a.map((c, k) => c + s * b[k]);
    const unit = (a) => a.map((c) => c / (Math.hypot(...a) || 1));
    for (const { places: line, faces: under, direction } of strokes) {
      const ends = direction ? line.map((p) => [p, plus(p, 0.06, unit(direction))]) : line.slice(1).map((p, k) => [line[k], p]);
      let since = Infinity;
      ends.forEach(([a, b], k) => {
        const ahead = unit(plus(b, -1, a)), side = unit(cross(normalAt(under[k], a), ahead));
        const [l, r] = [RIBBON, -RIBBON].map((s) => (p) => plus(p, s, side));
        corners.push(...l(a), ...r(a), ...l(b), ...l(b), ...r(a), ...r(b));
        since += Math.hypot(...plus(b, -1, a));
        if (since < (k < ends.length - 1 ? 0.12 : 0.06)) return; // an arrow every so often, and at the end
        since = 0;
        corners.push(...plus(b, 6 * RIBBON, ahead), ...plus(b, 4 * RIBBON, side), ...plus(b, -4 * RIBBON, side));
      });
    }
    ribbons.geometry.dispose();
    ribbons.geometry = new THREE.BufferGeometry();
    ribbons.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
    ribbons.visible = corners.length > 0;
    draw();
  }

  function placed(stroke) { // of a file, on the surface
    const at = stroke.points.map(toPage), target = new THREE.Vector3();
    const under = at.map((p) => tree.closestPointToPoint(target.set(...p)).faceIndex);
    return { ...stroke, places: at, faces: under };
  }

  // --- pointers

  const pointers = new Map();

  function where(event) {
    const { left, top } = stage.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  let rings = [];

  function ring(found) {
    const boxes = found.map(around);
    shared.brushes.value.forEach((brush, k) => {
      const hit = found[k];
      if (hit && (tool === "brush" || tool === "erase") && (isTexels || tool === "erase")) brush.set(...hit.point, size * hit.pixel);
      else brush.set(0, 0, 0, 0);
    });
    if (boxes.length || rings.length) draw([...boxes, ...rings]);
    rings = boxes;
  }

  canvas.addEventListener("pointerdown", (event) => {
    try {
      canvas.setPointerCapture(event.pointerId);
    } catch { /* it is gone already */ }
    at("middle").hidden = true;
    pointers.set(event.pointerId, event);
    if (pointers.size > 1) return pen && takeBack(); // a second finger: the first did not mean to paint
    if (event.button !== 0 || event.altKey || tool === "turn") return;
    aim();
    const [x, y] = where(event), found = hits(x, y);
    if (found.length) begin(x, y, found);
    ring(event.pointerType === "touch" ? [] : found);
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      if (name === "pointercancel" && pen) return takeBack();
      if (pen) {
        const [x, y] = where(event);
        if (Math.hypot(x - pen.x, y - pen.y) > 0.5) hits(x, y).forEach(dab); // up to where the pointer left
      }
      end();
    });
  canvas.addEventListener("pointerleave", () => ring([]));
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = where(event);
    at("middle").hidden = true;
    if (pen) {
      const ways = event.getCoalescedEvents ? event.getCoalescedEvents() : [];
      for (const one of ways.length ? ways : [event]) go(...where(one));
      if (event.pointerType !== "touch") ring(hits(x, y));
      return;
    }
    if (!pointers.has(event.pointerId)) return ring(hits(x, y));
    camera.drag(pointers, event, stage.clientHeight, 4);
  });

  // --- keys

  const onCanvas = { ...camera.keys, " ": inTheMiddle };
  const anywhere = {
    b: () => choose("brush"), x: () => choose("erase"), i: () => choose("chart"), p: () => choose("part"),
    c: () => choose("similar"), v: () => choose("turn"), "[": () => resize(size / 1.2), "]": () => resize(size * 1.2),
    m: () => reflect(mirror === null ? 0 : mirror === 2 ? null : mirror + 1),
  };

  async function inTheMiddle() {
    const [x, y] = [stage.clientWidth / 2, stage.clientHeight / 2];
    at("middle").hidden = false;
    aim();
    const found = hits(x, y);
    if (!found.length) return say("The middle of the picture shows no surface; turn the mesh first.");
    if (!isTexels && tool === "brush") return say("A stroke needs a pointer: drag along the surface.");
    await begin(x, y, found);
    end();
    ring(found);
  }

  document.addEventListener("keydown", (event) => {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey) {
      if (event.target.matches("#labels .name") && key !== "s") return;
      const action = { z: event.shiftKey ? redo : undo, y: redo, s: save }[key];
      if (!action || event.altKey) return;
      event.preventDefault();
      return action();
    }
    if (event.altKey || event.target.matches("input, select, summary")) return;
    if (event.target === canvas && onCanvas[key]) {
      event.preventDefault();
      return onCanvas[key]();
    }
    if (isTexels && "123456789".includes(key) && Number(key) < labels.length) return dip(Number(key));
    if (anywhere[key]) anywhere[key]();
  });

  // --- the panel

  const TOOLS = {
    brush: isTexels ? "Drag on the mesh to paint." : "Drag along the surface, the way the texture shall run.",
    erase: isTexels ? `Drag on the mesh: back to “${labels.length ? labels[0].name : ""}”.` : "Drag over strokes to take them away.",
    chart: "Click on the mesh to fill a UV island.",
    part: "Click on the mesh to fill a part: all that is connected.",
    similar: "Click on the mesh to fill what has a colour like it and is connected, across seams too.",
    turn: "Drag to turn, shift-drag to move, wheel or pinch to zoom.",
  };

  function choose(name) {
    const button = document.querySelector(`[data-tool=${name}]`);
    if (button.hidden) return;
    tool = name;
    for (const one of document.querySelectorAll("[data-tool]")) one.setAttribute("aria-pressed", one === button);
    canvas.classList.toggle("turning", tool === "turn");
    say(TOOLS[tool]);
    ring([]);
  }

  function dip(number) {
    label = number;
    [...at("labels").querySelectorAll("button")].forEach((one, k) => one.setAttribute("aria-pressed", k === label));
    if (tool === "erase" || tool === "turn") choose("brush");
    say(`Paints “${labels[label].name}”.`);
  }

  function resize(pixels) {
    size = Math.max(2, Math.min(200, pixels));
    at("size").value = size;
    at("size-said").textContent = `${Math.round(size)} pixels`;
  }

  function reflect(axis) {
    mirror = axis;
    at("mirror").value = axis === null ? "" : axis;
    say(axis === null ? "Strokes are not mirrored." : `Strokes are mirrored across the middle of ${"xyz"[axis]}.`);
  }

  function showPalette() {
    const bytes = shared.palette.value.image.data;
    labels.forEach(({ color }, k) => {
      const shown = OVERLAYS[data.mode]?.[k] ?? color, rgb = [1, 3, 5].map((n) => parseInt(shown.slice(n, n + 2), 16));
      bytes.set([...rgb, k ? 255 : 0], 4 * k); // what is not painted shows the texture
    });
    shared.palette.value.needsUpdate = true;
    draw();
  }

  function showLabels() {
    if (!isTexels) return;
    const fixed = data.mode === "keep";
    at("labels").replaceChildren(...labels.map((one, k) => {
      const row = element("li", ""), button = element("button", String(k), { type: "button" });
      button.setAttribute("aria-label", `Paint with ${one.name}`);
      button.setAttribute("aria-pressed", k === label);
      button.addEventListener("click", () => dip(k));
      row.append(button);
      if (fixed) {
        const swatch = element("span", "", { className: "swatch" });
        swatch.style.background = k ? OVERLAYS.keep[k] : "transparent";
        row.append(swatch, element("span", one.name, { className: "name" }));
        return row;
      }
      const color = element("input", "", { type: "color", value: one.color });
      color.setAttribute("aria-label", `Colour of ${one.name}`);
      color.addEventListener("input", () => { one.color = color.value; unsaved = true; showPalette(); });
      const name = element("input", "", { className: "name", value: one.name, maxLength: 60, autocomplete: "off" });
      name.setAttribute("aria-label", `Name of label ${k}`);
      name.addEventListener("change", () => {
        name.value = one.name = name.value.trim() || `label ${k}`;
        unsaved = true;
        button.setAttribute("aria-label", `Paint with ${one.name}`);
        color.setAttribute("aria-label", `Colour of ${one.name}`);
      });
      name.addEventListener("focus", () => label !== k && dip(k));
      row.append(color, name);
      return row;
    }));
    at("add").hidden = fixed || labels.length >= data.most;
    showPalette();
  }

  function another() { // a colour that no label has
    const hex = (n) => Math.round(n * 255).toString(16).padStart(2, "0");
    const wheel = Array.from({ length: 64 }, (_, k) => {
      const hue = (k * 0.618) % 1, channel = (n) => 0.5 + 0.45 * Math.cos(2 * Math.PI * (hue - n / 3));
      return `#${[0, 1, 2].map((n) => hex(channel(n))).join("")}`;
    });
    return [...data.suggestions, ...wheel].find((color) => !labels.some((one) => one.color === color));
  }

  at("add").addEventListener("click", () => {
    labels.push({ name: `label ${labels.length}`, color: another() });
    label = labels.length - 1;
    showLabels();
    dip(label);
    at("labels").lastElementChild.querySelector(".name").select();
  });
  for (const button of document.querySelectorAll("[data-tool]"))
    button.addEventListener("click", () => choose(button.dataset.tool));
  at("undo").addEventListener("click", undo);
  at("redo").addEventListener("click", redo);
  at("reset").addEventListener("click", reset);
  at("size").addEventListener("input", () => resize(Number(at("size").value)));
  at("mirror").addEventListener("change", () => reflect(at("mirror").value === "" ? null : Number(at("mirror").value)));
  at("unlit").addEventListener("change", () => { shared.unlit.value = at("unlit").checked ? 1 : 0; draw(); });
  at("opacity").addEventListener("input", () => { shared.opacity.value = at("opacity").value / 100; draw(); });
  at("tolerance").addEventListener("input", () => { at("tolerance-said").textContent = `${at("tolerance").value} %`; });

  // --- saving

  async function save() {
    end();
    say("Saving …");
    const content = isTexels
      ? { labels, numbers: await packed(ids) }
      : { strokes: strokes.map(({ points, direction }) => (direction ? { points, direction } : { points })) };
    const marks = [past.length, future.length].join();
    try {
      const said = await (await ask("save", JSON.stringify(content))).text();
      unsaved = [past.length, future.length].join() !== marks;
      say(`Saved ${data.out}: ${said}.`);
      return true;
    } catch (fault) {
      say(`Not saved: ${fault.message}`, true);
      return false;
    }
  }

  at("save").addEventListener("click", save);
  at("finish").addEventListener("click", async () => {
    if (!(await save())) return;
    const said = at("status").textContent;
    await ask("finish", "").catch(() => {});
    for (const one of document.querySelectorAll("button, input, select")) one.disabled = true;
    unsaved = false;
    say(`${said} flx has finished; this page can be closed.`);
  });
  addEventListener("beforeunload", (event) => unsaved && event.preventDefault());

  // --- the start

  for (const one of document.querySelectorAll("[data-texels]")) one.hidden = !isTexels;
  if (data.strokes) strokes = data.strokes.map(placed);
  at("notes").replaceChildren(...data.notes.map((line) => element("li", `${line}.`)));
  at("tolerance-said").textContent = `${at("tolerance").value} %`;
  resize(size);
  showLabels();
  showStrokes();
  choose("brush");
  canvas.addEventListener("webglcontextrestored", () => { stale = true; draw(); });
  new ResizeObserver(draw).observe(stage);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", colorScheme);
  colorScheme();
  dirty = null;
  drawNow();
  document.documentElement.dataset.ready = "yes";
})().catch((fault) => {
  document.getElementById("status").textContent = `This page cannot be shown here: ${fault.message}`;
  throw fault;
});
