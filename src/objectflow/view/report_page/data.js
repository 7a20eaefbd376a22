/* The page's data: the report as JSON, and a block for each pair of the gallery, decoded when the pair is shown. */

const report = JSON.parse(document.getElementById("report-data").textContent);
const TRUTH = -1;
const NO_FLOW = -32768;
const loading = new Map();

/** An element with attributes and children; text is never parsed as HTML. */
function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "class") node.className = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

function number(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

/** Base64 of deflated bytes -> bytes. */
async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Decode int16 values stored as consecutive differences, all low bytes before all high bytes. */
async function unpack16(text) {
  const bytes = await inflate(text);
  const count = bytes.length / 2;
  const values = new Int16Array(count);
  let last = 0;
  for (let i = 0; i < count; i++) {
    last = (last + (bytes[i] | (bytes[count + i] << 8))) & 0xffff;
    values[i] = last;
  }
  return values;
}

function decodeImage(uri) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error("a picture of this page cannot be decoded"));
    image.src = uri;
  });
}

/** The decoded data of one pair, cached. */
function loadPair(index) {
  if (!loading.has(index)) loading.set(index, readPair(index));
  return loading.get(index);
}

async function readPair(index) {
  const block = JSON.parse(document.getElementById(`pair-data-${index}`).textContent);
  const [width, height] = block.image;
  const [columns, rows] = block.grid;
  const [prev, curr] = await Promise.all([block.prev, block.curr].map(decodeImage));
  const depth = new Uint16Array((await unpack16(block.depth)).buffer);
  const layers = new Map();
  for (const layer of block.layers) {
    layers.set(layer.method, {
      labels: await inflate(layer.labels),
      flow: await unpack16(layer.flow),
      colors: layer.colors,
      objects: layer.objects,
    });
  }
  return { ...block, width, height, columns, rows, prev, curr, depth, layers, photo: pixelsOf(curr, width, height) };
}

function pixelsOf(image, width, height) {
  const canvas = el("canvas", { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

function layerName(method) {
  return method === TRUTH ? "truth" : report.methods[method].name;
}
