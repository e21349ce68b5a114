// Pictures made of masks in the browser: the outline of an object, and the object cut out.

import { useEffect, useState } from "../vendor/htm-preact.js";
import { artifactBlob } from "./artifacts.js";

const THRESHOLD = 128; // of a mask's grey levels
const OUTLINE = [255, 196, 0]; // RGB, as in the server's overlay
const FILL = 90; // of 255: how opaque a lit thing is
const MOST_SIDE = 1024; // px: outlines of larger pictures are made at this size

const SENT = new Set(["image/png", "image/jpeg", "image/webp"]); // as they are
const MOST_PIXELS = 24e6; // of a picture that is sent as it is
const SCALED_PIXELS = 12e6, QUALITY = 0.92; // of a JPEG that is made instead

/** A picture as the server takes it: {blob, width, height}. What is larger, or of another type that the browser shows, becomes a JPEG. */
export async function sendable(blob, { width, height }) {
  if (SENT.has(blob.type) && width * height <= MOST_PIXELS) return { blob, width, height };
  const scale = Math.min(1, Math.sqrt(SCALED_PIXELS / (width * height)));
  const size = { width: Math.round(width * scale), height: Math.round(height * scale) };
  const bitmap = await createImageBitmap(blob, { resizeWidth: size.width, resizeHeight: size.height, resizeQuality: "high" });
  const { canvas } = drawn(bitmap, size.width, size.height, "#fff");
  bitmap.close();
  return { blob: await new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", QUALITY)), ...size };
}

function drawn(image, width, height, ground = null) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (ground) {
    context.fillStyle = ground;
    context.fillRect(0, 0, width, height);
  }
  context.drawImage(image, 0, 0, width, height);
  return context;
}

const urlOf = (canvas) => new Promise((resolve) => canvas.toBlob((blob) => resolve(URL.createObjectURL(blob))));

/** Draws the outline of a mask instead of it; `fill` is how opaque what lies inside is, 0 to 255. */
function outlineIn(context, width, height, thickness, fill = 0) {
  const data = context.getImageData(0, 0, width, height);
  const inside = new Uint8Array(width * height);
  for (let i = 0; i < inside.length; i += 1) inside[i] = data.data[4 * i] >= THRESHOLD ? 1 : 0;
  const out = context.createImageData(width, height);
  for (let y = 0; y < height; y += 1) {
    for (let x = 0; x < width; x += 1) {
      const i = y * width + x;
      if (!inside[i]) continue;
      const edge = x < thickness || y < thickness || x >= width - thickness || y >= height - thickness
        || !inside[i - thickness] || !inside[i + thickness] || !inside[i - thickness * width] || !inside[i + thickness * width];
      if (edge || fill) out.data.set([...OUTLINE, edge ? 255 : fill], 4 * i);
    }
  }
  context.putImageData(out, 0, 0);
}

/** A mask, as a data URL, to lay over the image: its picture, and whether it covers a point of the image. */
export async function lightOf(mask) {
  const image = new Image();
  image.src = mask;
  await image.decode();
  const scale = Math.min(1, MOST_SIDE / Math.max(image.width, image.height));
  const [width, height] = [Math.round(image.width * scale), Math.round(image.height * scale)];
  const context = drawn(image, width, height);
  const { data } = context.getImageData(0, 0, width, height);
  outlineIn(context, width, height, Math.max(1, Math.round(width / 640)), FILL);
  const at = (value, length) => Math.min(length - 1, Math.max(0, Math.floor(value * scale)));
  const covers = ([x, y]) => data[4 * (at(y, height) * width + at(x, width))] >= THRESHOLD;
  return { href: context.canvas.toDataURL(), covers };
}

/** A picture of the outline of a mask, and the masked part of the image alone. */
async function madeOf(picture, maskSha256, bbox) {
  const blobs = [picture.blob ?? artifactBlob(picture.sha256), artifactBlob(maskSha256)];
  const [image, mask] = await Promise.all((await Promise.all(blobs)).map((blob) => createImageBitmap(blob)));
  const scale = Math.min(1, MOST_SIDE / Math.max(mask.width, mask.height));
  const [width, height] = [Math.round(mask.width * scale), Math.round(mask.height * scale)];
  const context = drawn(mask, width, height);
  const levels = context.getImageData(0, 0, width, height);
  outlineIn(context, width, height, Math.max(1, Math.round(width / 640)));
  const outline = await urlOf(context.canvas);
  const patch = drawn(image, width, height);
  const pixels = patch.getImageData(0, 0, width, height);
  for (let i = 3; i < pixels.data.length; i += 4) pixels.data[i] = levels.data[i - 3];
  patch.putImageData(pixels, 0, 0);
  const [x0, y0, x1, y1] = bbox.map((value) => Math.round(value * scale));
  const cut = document.createElement("canvas");
  [cut.width, cut.height] = [Math.max(1, x1 - x0), Math.max(1, y1 - y0)];
  cut.getContext("2d").drawImage(patch.canvas, -x0, -y0);
  return { outline, cutout: await urlOf(cut) };
}

/** {outline, cutout} of a mask as addresses; null until they are made, and where there is no mask. */
export function useCutout(picture, mask, bbox) {
  const [made, setMade] = useState({ of: null });
  const of = mask ? `${mask.sha256} ${picture.url}` : null;
  useEffect(() => {
    let wanted = true;
    let urls = null;
    if (of) {
      madeOf(picture, mask.sha256, bbox).then((found) => {
        urls = found;
        if (wanted) setMade({ of, ...found });
        else release(found);
      }, () => {}); // the box is drawn where there is no outline
    }
    return () => {
      wanted = false;
      if (urls) release(urls);
    };
  }, [of]);
  return made.of === of && of ? made : null;
}

const release = (urls) => Object.values(urls).forEach((url) => URL.revokeObjectURL(url));
