/* The 3D view: the current frame's points, moved back in time by the chosen flow, and motion arrows. */

class SceneView {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.01, 100);
    this.scene = new THREE.Scene();
    this.geometry = new THREE.BufferGeometry();
    this.material = new THREE.PointsMaterial({ size: 2, vertexColors: true, sizeAttenuation: true });
    // Points are as large as their spacing, which is proportional to depth.
    this.material.onBeforeCompile = (shader) => {
      const vertex = shader.vertexShader.replace("void main() {", "attribute float spread;\nvoid main() {");
      shader.vertexShader = vertex.replace("gl_PointSize = size;", "gl_PointSize = size * spread;");
    };
    this.points = new THREE.Points(this.geometry, this.material);
    this.points.frustumCulled = false;
    this.arrows = new THREE.Group();
    this.scene.add(this.points, this.arrows);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.addEventListener("change", () => this.render());
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** Show another pair, seen from the real camera's position. */
  setPair(pair) {
    this.pair = pair;
    const { columns, rows, depth, stride, offset } = pair;
    const [fx, fy, cx, cy] = pair.camera;
    const valid = [];
    for (let i = 0; i < columns * rows; i++) if (depth[i]) valid.push(i);
    this.valid = valid;
    this.curr = new Float32Array(3 * valid.length);
    valid.forEach((i, n) => {
      const z = depth[i] * pair.depth_step;
      const u = (i % columns) * stride + offset;
      const v = Math.floor(i / columns) * stride + offset;
      // three.js looks along -z with y up.
      this.curr.set([((u - cx) / fx) * z, (-(v - cy) / fy) * z, -z], 3 * n);
    });
    this.distance = median(valid.map((i) => depth[i])) * pair.depth_step || 1;
    this.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(this.curr.length), 3));
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(this.curr.length), 3));
    const spread = Float32Array.from(valid, (i) => depth[i] * pair.depth_step);
    this.geometry.setAttribute("spread", new THREE.BufferAttribute(spread, 1));
    // The point size of three.js does not include the field of view.
    this.material.size = ((1.35 * stride) / fx) * ((2 * fy) / (rows * stride));
    this.reset();
  }

  /** Return to the real camera's position and field of view; the orbit centre lies at the median depth. */
  reset() {
    const { rows, stride, camera } = this.pair;
    this.camera.fov = (2 * Math.atan((rows * stride) / (2 * camera[1])) * 180) / Math.PI;
    this.camera.near = this.distance / 100;
    this.camera.far = this.distance * 20;
    this.camera.position.set(0, 0, 0);
    this.controls.target.set(0, 0, -this.distance);
    this.resize();
    this.controls.update();
  }

  /** Draw a layer: colours, points at `time` (0 = previous, 1 = current frame) and motion arrows. */
  show({ method, color, time, arrows }) {
    const layer = this.pair.layers.get(method);
    const count = this.pair.columns * this.pair.rows;
    const position = this.geometry.getAttribute("position");
    const paint = this.geometry.getAttribute("color");
    const shade = new THREE.Color();
    this.valid.forEach((i, n) => {
      const known = layer.flow[i] !== NO_FLOW;
      for (let k = 0; k < 3; k++) {
        const back = known ? (layer.flow[k * count + i] / 1000) * (k === 0 ? 1 : -1) : 0;
        position.array[3 * n + k] = this.curr[3 * n + k] + (1 - time) * back;
      }
      const [red, green, blue] = this.colorOf(layer, color, i, count);
      shade.setRGB(red / 255, green / 255, blue / 255, THREE.SRGBColorSpace).toArray(paint.array, 3 * n);
    });
    position.needsUpdate = true;
    paint.needsUpdate = true;
    this.arrows.clear();
    if (arrows) for (const object of layer.objects) this.addArrow(object);
    this.render();
  }

  colorOf(layer, color, i, count) {
    const { columns, stride, offset, width, image_stride, photo, full } = this.pair;
    const small = (index, size) => Math.min(Math.floor((index * stride + offset) / image_stride), size - 1);
    const u = small(i % columns, width);
    const v = small(Math.floor(i / columns), this.pair.height);
    const pixel = v * width + u;
    if (color === "photo") return [photo[4 * pixel], photo[4 * pixel + 1], photo[4 * pixel + 2]];
    if (color === "objects") return objectColor(layer.colors[layer.labels[pixel]], photo, pixel);
    return flowColor(color, layer.flow, this.pair.layers.get(TRUTH).flow, i, count, full);
  }

  /** Draw the arrow from the object's previous to its current centre. */
  addArrow(object) {
    const end = flip(object.center);
    const start = flip(object.center.map((value, k) => value + object.translation[k]));
    const displacement = new THREE.Vector3().subVectors(end, start);
    const length = displacement.length();
    if (length < 0.003) return;
    const width = 0.006 * this.distance;
    const head = Math.min(5 * width, 0.6 * length);
    const up = new THREE.Vector3(0, 1, 0);
    const rotation = new THREE.Quaternion().setFromUnitVectors(up, displacement.clone().normalize());
    const part = (shape, from, to, color, inFront) => {
      // Drawn over the points, so that none of them hides an arrow.
      const material = new THREE.MeshBasicMaterial({ color, depthTest: false, depthWrite: false, transparent: true });
      const mesh = new THREE.Mesh(shape, material);
      mesh.position.lerpVectors(start, end, (from + to) / 2 / length);
      mesh.quaternion.copy(rotation);
      mesh.renderOrder = inFront ? 2 : 1;
      this.arrows.add(mesh);
    };
    const color = new THREE.Color().setRGB(...object.color.map((part_) => part_ / 255), THREE.SRGBColorSpace);
    const shaft = (radius) => new THREE.CylinderGeometry(radius, radius, length - head, 12);
    part(shaft(width / 2 + width * 0.35), 0, length - head, 0xffffff, false);
    part(new THREE.ConeGeometry(1.5 * width + width * 0.6, head + width * 1.2, 20), length - head - width * 0.4, length + width * 0.4, 0xffffff, false);
    part(shaft(width / 2), 0, length - head, color, true);
    part(new THREE.ConeGeometry(1.5 * width, head, 20), length - head, length, color, true);
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  render() {
    const ground = getComputedStyle(document.documentElement).getPropertyValue("--stage").trim();
    this.renderer.setClearColor(new THREE.Color(ground));
    this.renderer.render(this.scene, this.camera);
  }
}

function flip([x, y, z]) {
  return new THREE.Vector3(x, -y, -z);
}

function median(values) {
  return values.length ? [...values].sort((a, b) => a - b)[values.length >> 1] : 0;
}
