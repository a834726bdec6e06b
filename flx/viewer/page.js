// The viewer of flx. One WebGL context draws all panes, each in its own part of the canvas, with one camera.
"use strict";
(async () => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const stage = at("stage"), canvas = at("canvas"), panes = at("panes"), handle = at("handle");
  const { paintings, meshes, pictures } = data;
  const MOST = 6;
  const show = { wireframe: false, seams: false, unlit: false };
  let mode = "grid", split = 0.5, drawing = false;
  let chosen = paintings.map((_, n) => n).slice(0, MOST); // the panes of the grid
  let before = 0, after = Math.min(1, paintings.length - 1), sheet = after;

  // --- the bytes of the page

  function picture(url) {
    const image = new Image();
    image.src = url;
    return image.decode().then(() => image);
  }

  async function bytes(text) {
    const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }

  // --- surfaces: the light is that of flx's own pictures, from the viewer's left shoulder and the sky

  const VERTEX = `
    varying vec3 normalHere, towards;
    varying vec2 place;
    varying vec3 painted;
    void main() {
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      normalHere = normalMatrix * normal;
      towards = -seen.xyz;
      place = uv;
      #ifdef USE_COLOR
        painted = color;
      #endif
      gl_Position = projectionMatrix * seen;
    }`;
  const FRAGMENT = `
    varying vec3 normalHere, towards;
    varying vec2 place;
    varying vec3 painted;
    uniform sampler2D colors, alphas;
    uniform vec3 factor;
    uniform float opacity, cutoff, unlit;
    uniform bool hasAlpha;
    void main() {
      #ifdef USE_COLOR
        vec3 base = mix(painted / 12.92, pow((painted + 0.055) / 1.055, vec3(2.4)), step(0.04045, painted));
      #else
        vec3 base = texture2D(colors, place).rgb * factor;
      #endif
      float alpha = opacity * (hasAlpha ? texture2D(alphas, place).r : 1.0);
      if (alpha < cutoff) discard;
      if (cutoff > 0.0) alpha = 1.0;
      vec3 n = normalize(normalHere), eye = normalize(towards), key = normalize(vec3(-0.35, 0.5, 0.8));
      vec3 sky = (viewMatrix * vec4(0.0, 1.0, 0.0, 0.0)).xyz;
      if (dot(n, eye) < 0.0) n = -n;
      float soft = clamp((dot(n, key) + 0.25) / 1.25, 0.0, 1.0);
      vec3 lit = base * (0.30 + 0.08 * (dot(n, sky) + 1.0) + 0.58 * soft);
      lit += 0.03 * pow(clamp(dot(n, normalize(eye + key)), 0.0, 1.0), 60.0);
      gl_FragColor = vec4(mix(lit, base, unlit), alpha);
      #include <colorspace_fragment>
    }`;

  const uniforms = { unlit: { value: 0 } };
  const textures = new Map();

  function texture(url, isColor) {
    if (!textures.has(url)) {
      const made = new THREE.Texture();
      made.flipY = false;
      made.wrapS = made.wrapT = THREE.RepeatWrapping;
      made.anisotropy = 8;
      if (isColor) made.colorSpace = THREE.SRGBColorSpace;
      textures.set(url, picture(url).then((image) => {
        made.image = image;
        made.needsUpdate = true;
        return made;
      }));
    }
    return textures.get(url);
  }

  async function surface(mesh) {
    const names = ["positions", "normals", "uvs", "faces", "seams"];
    const [positions, normals, uvs, faces, seams] = await Promise.all(
      names.map((name) => mesh[name] && bytes(mesh[name])));
    const geometry = new THREE.BufferGeometry();
    const corners = new Uint32Array(faces), place = new THREE.BufferAttribute(new Uint16Array(positions), 3, true);
    geometry.setAttribute("position", place);
    geometry.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(normals), 3, true));
    if (uvs) geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uvs), 2));
    geometry.setIndex(new THREE.BufferAttribute(corners, 1));
    mesh.groups.forEach((group, n) => geometry.addGroup(3 * group.start, 3 * group.count, n));
    const edges = new Uint32Array(2 * corners.length); // those of two faces come twice
    for (let c = 0; c < corners.length; c++) {
      edges[2 * c] = corners[c];
      edges[2 * c + 1] = corners[c % 3 === 2 ? c - 2 : c + 1];
    }
    const body = new THREE.Mesh(geometry);
    const lines = [edges, new Uint32Array(seams)].map((ends, n) => {
      const of = new THREE.BufferGeometry();
      of.setAttribute("position", place);
      of.setIndex(new THREE.BufferAttribute(ends, 1));
      const look = { transparent: true, opacity: n ? 1 : 0.2, depthWrite: false };
      const made = new THREE.LineSegments(of, new THREE.LineBasicMaterial(look));
      made.renderOrder = 1 + n;
      return made;
    });
    const root = new THREE.Group();
    root.scale.setScalar(mesh.scale);
    root.position.set(...mesh.offset);
    root.add(body, ...lines);
    for (const one of root.children) one.frustumCulled = false;
    const turned = new THREE.Group();
    turned.add(root);
    if (data.up === "z") turned.rotation.x = -Math.PI / 2;
    const scene = new THREE.Scene();
    scene.add(turned);
    return { scene, body, geometry, wire: lines[0], seam: lines[1], corners, ends: edges, seams: lines[1].geometry.index.array };
  }

  async function materials(painting) {
    const mesh = meshes[painting.mesh];
    return Promise.all(mesh.groups.map(async (group) => {
      const alpha = group.alpha_mode !== "OPAQUE" && !painting.colors ? mesh.alphas[group.image] : null;
      return new THREE.ShaderMaterial({
        vertexShader: VERTEX,
        fragmentShader: FRAGMENT,
        side: THREE.DoubleSide,
        vertexColors: Boolean(painting.colors),
        transparent: group.alpha_mode === "BLEND",
        forceSinglePass: false, // what is seen through is drawn from the back
        polygonOffset: true,
        polygonOffsetFactor: 1,
        polygonOffsetUnits: 1,
        uniforms: {
          unlit: uniforms.unlit,
          colors: { value: painting.colors ? null : await texture(pictures[painting.pictures[group.image]], true) },
          alphas: { value: alpha ? await texture(alpha, false) : null },
          hasAlpha: { value: Boolean(alpha) },
          factor: { value: new THREE.Vector3(...group.factor) },
          opacity: { value: group.alpha_mode === "OPAQUE" ? 1 : group.opacity },
          cutoff: { value: group.alpha_mode === "MASK" ? group.cutoff : 0 },
        },
      });
    }));
  }

  // --- the camera, which all panes share

  const { aim, drag, keys, reset } = turntable(canvas, draw);
  const pointers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (pointers.has(event.pointerId)) drag(pointers, event, rectangles()[0]?.height || 400, 6);
  });
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });

  // --- drawing, when something changed

  let renderer = null, eye = null, surfaces = [], heavy = false;

  function rectangles() {
    const outer = stage.getBoundingClientRect();
    if (mode !== "grid") return [{ left: 0, top: 0, width: outer.width, height: outer.height }];
    return [...panes.querySelectorAll(".view")].map((pane) => {
      const { left, top, width, height } = pane.getBoundingClientRect();
      return { left: left - outer.left, top: top - outer.top, width, height };
    });
  }

  function paint(number) {
    const painting = paintings[number], one = surfaces[painting.mesh];
    one.body.material = painting.materials;
    if (painting.vertexColors) one.geometry.setAttribute("color", painting.vertexColors);
    one.wire.visible = show.wireframe;
    one.seam.visible = show.seams;
    renderer.render(one.scene, eye);
  }

  function box(rectangle, from = 0, to = 1) {
    const { left, top, width, height } = rectangle, bottom = stage.clientHeight - top - height;
    renderer.setViewport(left, bottom, width, height);
    renderer.setScissor(left + from * width, bottom, (to - from) * width, height);
    aim(eye, width, height);
  }

  function drawNow() {
    drawing = false;
    if (!renderer || mode === "atlas") return;
    const width = stage.clientWidth, height = stage.clientHeight, ratio = Math.min(devicePixelRatio || 1, 2);
    if (renderer.getPixelRatio() !== ratio) renderer.setPixelRatio(ratio);
    if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio))
      renderer.setSize(width, height, false);
    uniforms.unlit.value = show.unlit ? 1 : 0;
    const places = rectangles();
    if (mode === "grid") places.forEach((place, n) => { box(place); paint(chosen[n]); });
    else {
      box(places[0], 0, split);
      paint(before);
      box(places[0], split, 1);
      paint(after);
    }
  }

  function draw() {
    if (drawing) return;
    drawing = true;
    requestAnimationFrame(drawNow);
  }

  function colorScheme() {
    if (!renderer) return;
    const style = getComputedStyle(document.documentElement), color = (name) => style.getPropertyValue(name).trim();
    renderer.setClearColor(color("--stage"));
    for (const one of surfaces) {
      one.wire.material.color.set(color("--wire"));
      one.seam.material.color.set(color("--seam"));
    }
  }

  function thumbnail(number) {
    const made = element("canvas", "", { width: 176, height: 132 });
    const flat = pictures[paintings[number].pictures[0]];
    if (!renderer || (heavy && flat)) return Object.assign(new Image(), { src: flat || "", alt: "" });
    renderer.setPixelRatio(1);
    renderer.setSize(176, 132, false);
    renderer.setViewport(0, 0, 176, 132);
    renderer.setScissor(0, 0, 176, 132);
    aim(eye, 176, 132);
    paint(number);
    made.getContext("2d").drawImage(canvas, 0, 0);
    return made;
  }

  // --- the atlas, with the lines of the mesh on it

  function lines(canvas, image, number) {
    const one = surfaces[paintings[number].mesh], mesh = meshes[paintings[number].mesh];
    const uvs = one.geometry.getAttribute("uv").array, pen = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const rows = new Set(), used = mesh.groups.filter((group) => group.image === image);
    for (const { start, count } of used) for (let c = 3 * start; c < 3 * (start + count); c++) rows.add(one.corners[c]);
    for (const [wanted, ends, name] of [[show.wireframe, one.ends, "--wire"], [show.seams, one.seams, "--seam"]]) {
      if (!wanted) continue;
      pen.beginPath();
      for (let k = 0; k < ends.length; k += 2) {
        const [a, b] = [ends[k], ends[k + 1]];
        if (!rows.has(a) || !rows.has(b)) continue;
        const shift = [0, 1].map((axis) => Math.floor(Math.min(uvs[2 * a + axis], uvs[2 * b + axis]) + 1e-6));
        pen.moveTo((uvs[2 * a] - shift[0]) * canvas.width, (uvs[2 * a + 1] - shift[1]) * canvas.height);
        pen.lineTo((uvs[2 * b] - shift[0]) * canvas.width, (uvs[2 * b + 1] - shift[1]) * canvas.height);
      }
      pen.strokeStyle = style.getPropertyValue(name);
      pen.globalAlpha = name === "--wire" ? 0.5 : 1;
      pen.lineWidth = canvas.width / (name === "--wire" ? 1000 : 400);
      pen.stroke();
    }
  }

  async function sheets() {
    const painting = paintings[sheet];
    const figures = await Promise.all(painting.pictures.map(async (number, image) => {
      const shown = await picture(pictures[number]), figure = element("figure", "");
      shown.alt = `Atlas of ${painting.name}`;
      const holder = element("div", "", { className: "sheet" }), over = element("canvas", "");
      const size = 2048 / Math.max(shown.width, shown.height);
      Object.assign(over, { width: shown.width * size, height: shown.height * size });
      if (renderer && (show.wireframe || show.seams)) lines(over, image, sheet);
      holder.append(shown, over);
      const many = painting.pictures.length > 1 ? ` (image ${image + 1})` : "";
      figure.append(holder, element("figcaption", painting.name + many));
      return figure;
    }));
    if (!figures.length) figures.push(element("p", "This mesh has colours at its vertices, and no atlas."));
    at("atlas").replaceChildren(...figures);
  }

  // --- what the buttons do

  function link(painting) {
    const made = element("a", painting.file, { href: "./" + encodeURIComponent(painting.file) });
    made.setAttribute("download", painting.file);
    return made;
  }

  function arrange() {
    const { clientWidth: width, clientHeight: height } = stage, count = chosen.length;
    let best = 1, size = 0;
    for (let columns = 1; columns <= count; columns++) {
      const side = Math.min(width / columns, height / Math.ceil(count / columns));
      if (side > size) [best, size] = [columns, side];
    }
    panes.style.gridTemplate = `repeat(${Math.ceil(count / best)}, 1fr) / repeat(${best}, 1fr)`;
    draw();
  }

  function update() {
    for (const button of document.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", button.dataset.mode === mode);
    for (const button of document.querySelectorAll("[data-toggle]"))
      button.setAttribute("aria-pressed", show[button.dataset.toggle]);
    const marked = { grid: chosen, compare: [before, after], atlas: [sheet] }[mode];
    [...at("choice").children].forEach((button, n) => button.setAttribute("aria-pressed", marked.includes(n)));
    canvas.hidden = mode === "atlas";
    panes.hidden = mode !== "grid";
    at("split").hidden = mode !== "compare";
    at("atlas").hidden = mode !== "atlas";
    panes.replaceChildren(...chosen.map((n) => {
      const pane = element("div", "", { className: "pane" }), label = element("p", paintings[n].name);
      if (paintings[n].file && beside) {
        const download = link(paintings[n]);
        download.textContent = "download";
        download.setAttribute("aria-label", `Download ${paintings[n].file}`);
        label.append(download);
      }
      pane.append(element("div", "", { className: "view" }), label);
      return pane;
    }));
    [at("before").value, at("after").value] = [before, after];
    handle.style.left = `${100 * split}%`;
    handle.setAttribute("aria-valuenow", Math.round(100 * split));
    const words = {
      grid: `${chosen.length} of ${paintings.length} shown, at most ${MOST} at a time. Drag to turn all, wheel or pinch to zoom, shift-drag to move.`,
      compare: `Left: ${paintings[before].name}. Right: ${paintings[after].name}. Drag the line, or give it arrow keys.`,
      atlas: `The texture of ${paintings[sheet].name}, as it lies on the UVs of the mesh.`,
    };
    at("status").textContent = renderer ? words[mode] : "There is no WebGL in this browser: the page shows the atlas images alone.";
    if (mode === "atlas") sheets();
    arrange();
  }

  function choose(n) {
    if (mode === "grid") {
      if (!chosen.includes(n)) {
        chosen = [...chosen, n];
        if (chosen.length > MOST) chosen.splice(chosen[0] === 0 ? 1 : 0, 1); // the input stays longest
        chosen.sort((a, b) => a - b);
      } else if (chosen.length > 1) chosen = chosen.filter((one) => one !== n);
    } else if (mode === "compare") after = n;
    else sheet = n;
    update();
  }

  function slide(share) {
    split = Math.max(0, Math.min(1, share));
    update();
  }

  handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
  handle.addEventListener("pointermove", (event) => {
    const { left, width } = stage.getBoundingClientRect();
    if (handle.hasPointerCapture(event.pointerId)) slide((event.clientX - left) / width);
  });
  handle.addEventListener("keydown", (event) => {
    const to = { ArrowLeft: split - 0.02, ArrowRight: split + 0.02, Home: 0, End: 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    slide(to);
  });
  for (const button of document.querySelectorAll("[data-mode]"))
    button.addEventListener("click", () => { mode = button.dataset.mode; update(); });
  for (const button of document.querySelectorAll("[data-toggle]"))
    button.addEventListener("click", () => { show[button.dataset.toggle] = !show[button.dataset.toggle]; update(); });
  at("reset").addEventListener("click", reset);
  at("before").addEventListener("change", (event) => { before = Number(event.target.value); update(); });
  at("after").addEventListener("change", (event) => { after = Number(event.target.value); update(); });

  // --- the tables below

  const beside = location.protocol !== "about:"; // in a frame of a notebook no file is beside the page
  const named = paintings.filter((painting) => painting.file);
  const distinct = named.filter((one, n) => named.findIndex((other) => other.file === one.file) === n);
  at("where").textContent = !named.length
    ? "No mesh file was written with this page."
    : beside
      ? "The meshes stand beside this page, in its folder. If the page came alone, ask its sender for them."
      : "The meshes are in the folder that this page comes from.";
  at("files").replaceChildren(...distinct.map((painting) => {
    const row = element("li", beside ? "" : painting.file);
    if (beside) row.append(link(painting));
    return row;
  }));
  at("settings").replaceChildren(...data.settings.map(([name, value]) => {
    const row = element("tr", "");
    row.append(element("td", name.replaceAll("_", " ")), element("td", value));
    return row;
  }));
  at("brief").textContent = data.settings.map(([name, value]) => `${name.replaceAll("_", " ")} ${value}`).join(" · ");
  at("notes").replaceChildren(...data.notes.map((note) => element("li", note)));
  for (const id of ["before", "after"])
    at(id).replaceChildren(...paintings.map((painting, n) => element("option", painting.name, { value: n })));

  // --- the start

  at("status").textContent = "Loading …";
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    renderer.setScissorTest(true);
  } catch {
    renderer = null;
    mode = "atlas";
  }
  if (renderer) {
    eye = new THREE.PerspectiveCamera();
    surfaces = await Promise.all(meshes.map(surface));
    for (const painting of paintings) {
      painting.materials = await materials(painting);
      if (painting.colors) {
        const colors = new Uint8Array(await bytes(painting.colors));
        painting.vertexColors = new THREE.BufferAttribute(colors, 3, true);
      }
    }
    colorScheme();
  }
  const faces = (painting) => surfaces[painting.mesh].corners.length / 3;
  heavy = Boolean(renderer) && paintings.map(faces).reduce((a, b) => a + b, 0) > 4e6; // then each is drawn when it is chosen
  for (const button of document.querySelectorAll("[data-mode=grid], [data-mode=compare], [data-toggle], #reset"))
    button.disabled = !renderer;
  if (!meshes.some((mesh) => mesh.uvs)) document.querySelector("[data-toggle=seams]").disabled = true;
  at("choice").replaceChildren(...paintings.map((painting, n) => {
    const button = element("button", "", { type: "button" });
    button.append(thumbnail(n), element("span", painting.name));
    button.addEventListener("click", () => choose(n));
    return button;
  }));
  canvas.addEventListener("webglcontextrestored", draw);
  new ResizeObserver(arrange).observe(stage);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colorScheme(); update(); });
  update();
  document.documentElement.dataset.ready = "yes";
})().catch((fault) => {
  document.getElementById("status").textContent = `This page cannot be shown here: ${fault.message}`;
  throw fault;
});
