"use strict";
// Film of a user's own frames, with the tracks drawn over it.
(() => {
  const TAIL_S = 8, STEP_MS = 250;
  const byId = (id) => document.getElementById(id);
  const { times_s, tracks, shape, pictures } = JSON.parse(byId("data").textContent);
  const canvas = byId("canvas"), slider = byId("frame"), play = byId("play");
  const images = pictures.map((text) => {
    const image = new Image();
    image.onload = draw;
    image.src = `data:image/jpeg;base64,${text}`;
    return image;
  });
  let timer = null;

  function draw() {
    const k = Number(slider.value), ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(width * shape);
    if (!width || !times_s.length) return;
    canvas.width = width;
    canvas.height = height;
    const ctx = canvas.getContext("2d"), image = images[k];
    ctx.fillStyle = "#000";
    ctx.fillRect(0, 0, width, height);
    if (image && image.complete && image.naturalWidth) ctx.drawImage(image, 0, 0, width, height);
    ctx.lineWidth = 1.5 * ratio;
    ctx.font = `${11 * ratio}px sans-serif`;
    for (const [ident, rows] of tracks) {
      const tail = rows.filter(([at]) => at <= k && times_s[at] >= times_s[k] - TAIL_S);
      const now = tail[tail.length - 1];
      if (!now || now[0] !== k) continue;
      ctx.strokeStyle = ctx.fillStyle = `hsl(${(ident * 137) % 360} 90% 65%)`;
      ctx.beginPath();
      for (const [, x, y] of tail) ctx.lineTo(x * width, y * height);
      ctx.stroke();
      ctx.beginPath();
      ctx.arc(now[1] * width, now[2] * height, 5 * ratio, 0, 2 * Math.PI);
      ctx.stroke();
      if (byId("numbers").checked) ctx.fillText(ident, now[1] * width + 7 * ratio, now[2] * height - 5 * ratio);
    }
    byId("time").textContent = `${k + 1} of ${times_s.length}, ${times_s[k].toFixed(2)} s`;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  play.addEventListener("click", () => {
    if (timer) return stop();
    play.textContent = "Pause";
    timer = setInterval(() => {
      slider.value = (Number(slider.value) + 1) % times_s.length;
      draw();
    }, STEP_MS);
  });
  slider.addEventListener("input", draw);
  byId("numbers").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas.parentElement);
  theme.start(draw);
})();
