/* Colours, identical to those of the pictures of `objectflow estimate` (view/colors.py). */

const NO_DEPTH = [222, 226, 230];

/** Hue = direction, saturation = length; white at 0, full at length 1 and beyond. */
function wheel(right, down) {
  const length = Math.min(Math.hypot(right, down), 1) ** 0.8;
  const angle = Math.atan2(down, right);
  return [0, 1, 2].map((k) => {
    const hue = (0.5 + 0.5 * Math.cos(angle - (k * 2 * Math.PI) / 3)) ** 0.8 * 235;
    return Math.round(255 + (hue - 255) * length);
  });
}

/** Red at -1 and below, white at 0, blue at 1 and beyond. */
function diverging(value) {
  const strength = Math.min(Math.abs(value), 1) ** 0.8;
  const end = value < 0 ? [178, 24, 43] : [33, 102, 172];
  return end.map((part) => Math.round(255 + (part - 255) * strength));
}

const HEAT = [[255, 255, 255], [253, 212, 130], [240, 120, 60], [180, 30, 70], [60, 10, 70]];

/** White at 0 through yellow and red to dark violet at 1 and beyond. */
function heat(value) {
  const place = Math.min(Math.max(value, 0), 1) * (HEAT.length - 1);
  const low = Math.min(Math.floor(place), HEAT.length - 2);
  return HEAT[low].map((part, k) => Math.round(part + (HEAT[low + 1][k] - part) * (place - low)));
}

const FLOW_PICTURES = {
  across: "motion across the image",
  depth: "motion in depth",
  error: "error against the truth",
};

/** The colour of one point's flow [mm, previous minus current]; `truth` is used by kind "error" only. */
function flowColor(kind, flow, truth, i, count, full) {
  const mm = 1000 * full;
  if (flow[i] === NO_FLOW) return NO_DEPTH;
  // Motion is shown forward in time.
  if (kind === "across") return wheel(-flow[i] / mm, -flow[count + i] / mm);
  if (kind === "depth") return diverging(-flow[2 * count + i] / mm);
  if (truth[i] === NO_FLOW) return NO_DEPTH;
  const difference = [0, 1, 2].map((k) => flow[k * count + i] - truth[k * count + i]);
  return heat(Math.hypot(...difference) / mm);
}

function css(color) {
  return `rgb(${color.join(" ")})`;
}
