/* Start: theme, the scene over time, and each model when it scrolls into view. */

const scene = {
  canvas: document.getElementById("scene"),
  time: document.getElementById("time"),
  words: document.getElementById("time-words"),
  play: document.getElementById("play"),
  tint: document.getElementById("tint"),
  trails: document.getElementById("trails"),
  ground: document.getElementById("ground"),
  view: null,
  data: null,
  objects: [],
  background: null,
  timer: null,
};
const PLAY_MS = 250;

/** An octahedron, which marks an object without a model; radius in metres. */
function markerGeometry(radius) {
  const corners = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]].flat();
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners.map((v) => radius * v)), 3));
  geometry.setIndex([0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]);
  return geometry;
}

function position(pose) {
  return new THREE.Vector3(pose[3], pose[7], pose[11]);
}

/** A bar between two points, drawn in front of everything, so that no model hides a trail. */
function bar(start, end, radius, color) {
  const along = new THREE.Vector3().subVectors(end, start);
  const length = along.length();
  const material = new THREE.MeshBasicMaterial({ color, depthTest: false, transparent: true });
  const mesh = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length, 8), material);
  mesh.position.lerpVectors(start, end, 0.5);
  mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.normalize());
  mesh.renderOrder = 1;
  return mesh;
}

async function addObject(entry) {
  const { view, data } = scene;
  const color = trackColor(entry.color);
  const known = data.models.includes(entry.id);
  const model = known ? await loadModel(entry.id) : { geometry: markerGeometry(0.012) };
  const mesh = new THREE.Mesh(model.geometry, meshMaterial(known ? null : color));
  mesh.matrixAutoUpdate = false;
  view.root.add(mesh);
  const bars = [];
  for (let k = 1; k < entry.poses.length; k++) {
    const [start, end] = [position(entry.poses[k - 1]), position(entry.poses[k])];
    if (start.distanceTo(end) < 0.0005) continue;
    const mesh_ = bar(start, end, 0.0025, color);
    view.root.add(mesh_);
    bars.push({ frame: entry.frames[k], mesh: mesh_ });
  }
  const materials = { photo: mesh.material, tint: known ? meshMaterial(color) : mesh.material };
  scene.objects.push({ entry, mesh, bars, materials });
}

async function addBackground(block) {
  const words = await unpack16(block.points);
  const count = words.length / 3;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(triples(words, count, (v) => v * block.step), 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(vertexColors(await inflate(block.colors)), 3));
  geometry.computeBoundingSphere();
  // Overlapping points look like a surface.
  const size = 2 * block.spacing;
  const points = new THREE.Points(geometry, new THREE.PointsMaterial({ size, vertexColors: true, sizeAttenuation: true }));
  scene.background = points;
  scene.view.root.add(points);
}

/** Place every object at its last pose up to the chosen frame. */
function showTime() {
  const now = Number(scene.time.value);
  scene.words.textContent = scene.data.words[now];
  for (const { entry, mesh, bars, materials } of scene.objects) {
    let k = entry.frames.length - 1;
    while (k >= 0 && entry.frames[k] > now) k--;
    mesh.visible = k >= 0;
    if (k >= 0) mesh.matrix.set(...entry.poses[k], 0, 0, 0, 1);
    mesh.material = scene.tint.checked ? materials.tint : materials.photo;
    for (const { frame, mesh: one } of bars) one.visible = scene.trails.checked && frame <= now;
  }
  if (scene.background) scene.background.visible = scene.ground.checked;
  scene.view.render();
}

/** Look at the paths of all objects, with some room for what stands around them. */
function lookAtPaths() {
  const places = scene.objects.flatMap(({ entry }) => entry.poses.map(position));
  if (!places.length && scene.background) places.push(scene.background.geometry.boundingSphere.center.clone());
  const center = new THREE.Vector3();
  for (const place of places) center.add(place);
  center.multiplyScalar(1 / Math.max(places.length, 1));
  const reach = places.reduce((most, place) => Math.max(most, place.distanceTo(center)), 0);
  scene.view.frame(center, reach + 0.2, [0.1, 0.35, 1]);
}

function setPlaying(on) {
  clearInterval(scene.timer);
  scene.timer = null;
  scene.play.textContent = on ? "Pause" : "Play";
  if (!on) return;
  scene.timer = setInterval(() => {
    scene.time.value = (Number(scene.time.value) + 1) % scene.data.frames.length;
    showTime();
  }, PLAY_MS);
}

async function startScene() {
  scene.data = JSON.parse(document.getElementById("scene-data").textContent);
  if (!sharedRenderer()) {
    scene.canvas.replaceWith(el("p", { class: "message" }, shared.failed));
    return;
  }
  scene.view = new View3D(scene.canvas);
  for (const entry of scene.data.objects) await addObject(entry);
  if (scene.data.background) await addBackground(scene.data.background);
  else scene.ground.parentElement.hidden = true;
  scene.time.max = scene.data.frames.length - 1;
  scene.time.value = scene.time.max;
  for (const input of [scene.time, scene.tint, scene.trails, scene.ground]) input.addEventListener("input", showTime);
  scene.play.addEventListener("click", () => setPlaying(scene.timer === null));
  document.getElementById("reset").addEventListener("click", lookAtPaths);
  lookAtPaths();
  showTime();
  scene.canvas.dataset.ready = "true";
}

function startModels() {
  const watcher = new IntersectionObserver(
    (entries) => {
      for (const entry of entries) {
        if (!entry.isIntersecting) continue;
        watcher.unobserve(entry.target);
        showModel(entry.target);
      }
    },
    { rootMargin: "300px" },
  );
  document.querySelectorAll("canvas[data-model]").forEach((canvas) => watcher.observe(canvas));
}

startTheme();
startModels();
startScene();
