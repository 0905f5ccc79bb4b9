// Canvases that fill their place on the page, and the colours of the theme.

export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// The canvas in device pixels, cleared; null while it has no size on the page.
export function cleared(canvas) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [Math.round(scale * canvas.clientWidth), Math.round(scale * canvas.clientHeight)];
  if (width === 0 || height === 0) return null;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height, scale };
}

// A function that has `draw` called before the next frame, once however often it is called.
export function beforeNextFrame(draw) {
  let isWaiting = false;
  return () => {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame((now_ms) => {
      isWaiting = false;
      draw(now_ms);
    });
  };
}
