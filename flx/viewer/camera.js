// What the pages of flx share: a camera that turns around the mesh, by pointers and keys, and elements.
"use strict";

function element(tag, text, more = {}) {
  const made = Object.assign(document.createElement(tag), more);
  made.textContent = text;
  return made;
}

function turntable(canvas, draw) { // `draw` is called when the camera has moved
  const FIELD = (25 * Math.PI) / 180, HOME = { azimuth: Math.PI / 6, elevation: Math.PI / 9, zoom: 1, x: 0, y: 0, z: 0 };
  const camera = { ...HOME };

  function lens() {
    const { azimuth: a, elevation: e, zoom } = camera;
    const towards = [Math.cos(e) * Math.sin(a), Math.sin(e), Math.cos(e) * Math.cos(a)];
    const right = [Math.cos(a), 0, -Math.sin(a)];
    const up = [-Math.sin(e) * Math.sin(a), Math.cos(e), -Math.sin(e) * Math.cos(a)];
    return { towards, right, up, distance: (1.02 / Math.sin(FIELD / 2)) * zoom };
  }

  function turn(dx, dy) {
    camera.azimuth -= dx;
    camera.elevation = Math.max(-1.55, Math.min(1.55, camera.elevation + dy));
    draw();
  }

  function zoom(share) {
    camera.zoom = Math.max(0.02, Math.min(6, camera.zoom * share));
    draw();
  }

  function pan(dx, dy) { // in shares of the height of the picture
    const { right, up, distance } = lens(), length = 2 * distance * Math.tan(FIELD / 2);
    ["x", "y", "z"].forEach((axis, k) => (camera[axis] += length * (dy * up[k] - dx * right[k])));
    draw();
  }

  function reset() {
    Object.assign(camera, HOME);
    draw();
  }

  function aim(eye, width, height) { // a camera of three.js, for a picture of this size
    const { towards, up, distance } = lens(), aspect = width / height;
    eye.aspect = aspect;
    eye.fov = ((2 * Math.atan(Math.tan(FIELD / 2) / Math.min(1, aspect))) * 180) / Math.PI;
    eye.near = Math.max(distance / 1000, distance - 4);
    eye.far = distance + 8;
    eye.position.set(...towards.map((t, k) => camera["xyz"[k]] + t * distance));
    eye.up.set(...up);
    eye.lookAt(camera.x, camera.y, camera.z);
    eye.updateProjectionMatrix();
  }

  // A pointer has moved on a picture of this height: it turns, or moves the view with Shift or these buttons; two
  // fingers move and zoom it.
  function drag(pointers, event, height, buttons) {
    const last = pointers.get(event.pointerId), dx = event.clientX - last.clientX, dy = event.clientY - last.clientY;
    const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
    pointers.set(event.pointerId, event);
    if (other) {
      const length = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      pan(dx / 2 / height, dy / 2 / height);
      zoom(Math.max(1, length(last)) / Math.max(1, length(event)));
    } else if (event.shiftKey || event.buttons & buttons) pan(dx / height, dy / height);
    else turn((dx / Math.min(height, 600)) * Math.PI, (dy / Math.min(height, 600)) * Math.PI);
  }

  const step = Math.PI / 24;
  const keys = {
    ArrowLeft: () => turn(-step, 0), ArrowRight: () => turn(step, 0),
    ArrowUp: () => turn(0, step), ArrowDown: () => turn(0, -step),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9), 0: reset,
  };

  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-200, Math.min(200, event.deltaY)) * 0.0015));
  }, { passive: false });
  return { aim, drag, keys, reset };
}
