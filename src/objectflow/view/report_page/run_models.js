/* 3D views of the models. All views share one WebGL context, since browsers limit their number. */

const shared = { renderer: null, failed: "" };

/** The page's WebGL renderer, created on first use; null where the browser has none. */
function sharedRenderer() {
  if (shared.renderer || shared.failed) return shared.renderer;
  try {
    shared.renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    shared.failed = `This browser cannot draw in 3D (WebGL 2 is off): ${error.message}`;
  }
  return shared.renderer;
}

/** Reads three rows of N values, stored row after row. */
function triples(values, count, of) {
  const out = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) out[3 * i + k] = of(values[k * count + i], k);
  return out;
}

function vertexColors(bytes) {
  const out = new Float32Array(bytes.length);
  const shade = new THREE.Color();
  for (let i = 0; i < bytes.length; i += 3) {
    shade.setRGB(bytes[i] / 255, bytes[i + 1] / 255, bytes[i + 2] / 255, THREE.SRGBColorSpace).toArray(out, i);
  }
  return out;
}

function trackColor(color) {
  return new THREE.Color().setRGB(color[0] / 255, color[1] / 255, color[2] / 255, THREE.SRGBColorSpace);
}

const models = new Map();

/** The decoded mesh of one object, in its object frame, metres; cached. */
function loadModel(number) {
  if (!models.has(number)) models.set(number, readModel(number));
  return models.get(number);
}

async function readModel(number) {
  const block = JSON.parse(document.getElementById(`model-${number}`).textContent);
  const words = new Uint16Array((await unpack16(block.vertices)).buffer);
  const faces = new Uint16Array((await unpack16(block.faces)).buffer);
  const count = words.length / 3;
  const corners = faces.length / 3;
  const geometry = new THREE.BufferGeometry();
  const place = (value, k) => block.lower[k] + value * block.step;
  geometry.setAttribute("position", new THREE.BufferAttribute(triples(words, count, place), 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(vertexColors(await inflate(block.colors)), 3));
  const index = new Uint32Array(3 * corners);
  for (let i = 0; i < corners; i++) for (let k = 0; k < 3; k++) index[3 * i + k] = faces[k * corners + i];
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
  geometry.computeBoundingSphere();
  return { geometry, color: block.color };
}

/** Double-sided, since meshes are open where the surface was not seen. */
function meshMaterial(tint) {
  return new THREE.MeshBasicMaterial({ vertexColors: tint === null, color: tint ?? 0xffffff, side: 2 });
}

class View3D {
  constructor(canvas) {
    this.canvas = canvas;
    this.scene = new THREE.Scene();
    this.root = new THREE.Group();
    // three.js looks along -z with y up; our frames have y down and z forward.
    this.root.rotation.x = Math.PI;
    this.scene.add(this.root);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.001, 100);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.addEventListener("change", () => this.render());
    new ResizeObserver(() => this.render()).observe(canvas);
    window.addEventListener("themechange", () => this.render());
  }

  /** Look at a sphere, given in the axes of the data, from the side of the first camera and above it. */
  frame(center, radius, direction = [0.35, 0.45, 1]) {
    const target = new THREE.Vector3(center.x, -center.y, -center.z);
    const distance = (1.15 * radius) / Math.sin((this.camera.fov * Math.PI) / 360);
    const toward = new THREE.Vector3(...direction).normalize().multiplyScalar(distance);
    this.camera.near = distance / 200;
    this.camera.far = distance * 20;
    this.camera.position.copy(target).add(toward);
    this.controls.target.copy(target);
    this.controls.update();
    this.render();
  }

  render() {
    const renderer = sharedRenderer();
    const { clientWidth, clientHeight } = this.canvas;
    if (!renderer || !clientWidth || !clientHeight) return;
    const ratio = Math.min(window.devicePixelRatio, 2);
    const [width, height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    renderer.setSize(width, height, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    const ground = getComputedStyle(document.documentElement).getPropertyValue("--stage").trim();
    renderer.setClearColor(new THREE.Color(ground));
    renderer.render(this.scene, this.camera);
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    this.canvas.getContext("2d").drawImage(renderer.domElement, 0, 0);
  }
}

async function showModel(canvas) {
  if (!sharedRenderer()) {
    canvas.replaceWith(el("p", { class: "message" }, shared.failed));
    return;
  }
  const { geometry } = await loadModel(Number(canvas.dataset.model));
  const view = new View3D(canvas);
  view.root.add(new THREE.Mesh(geometry, meshMaterial(null)));
  const { center, radius } = geometry.boundingSphere;
  view.frame(center, radius);
  canvas.dataset.ready = "true";
}
