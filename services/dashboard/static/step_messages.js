// Binary messages with steps of rollouts → header and typed arrays (see rollout_feeds.steps_message).

export const STEPS_KIND = 2;
const HEADER_START = 8;

export function readHeader(buffer) {
  const length = new DataView(buffer).getUint32(4, true);
  const text = new TextDecoder().decode(new Uint8Array(buffer, HEADER_START, length));
  return { header: JSON.parse(text), offset: HEADER_START + length };
}

// Steps of one response: touch by side, and images by camera, as views of the message.
export function readSteps(buffer) {
  if (new DataView(buffer).getUint8(0) !== STEPS_KIND) return null;
  const { header, offset: start } = readHeader(buffer);
  const count = header.steps.length;
  let offset = start;
  let touch = null;
  if (header.has_touch) {
    touch = new Float32Array(buffer, offset, count * 2 * header.num_taxels);
    offset += touch.byteLength;
  }
  const cameras = header.cameras.map(({ name, height, width }) => {
    const pixels = new Uint8Array(buffer, offset, count * height * width * 3);
    offset += pixels.byteLength;
    return { name, height, width, pixels };
  });
  return { header, touch, cameras };
}

export function touchOf(steps, index, side) {
  if (!steps.touch) return null;
  const { num_taxels } = steps.header;
  const start = (2 * index + (side === "left" ? 0 : 1)) * num_taxels;
  return steps.touch.subarray(start, start + num_taxels);
}

export function imageOf(camera, index) {
  const size = camera.height * camera.width * 3;
  return camera.pixels.subarray(index * size, (index + 1) * size);
}
