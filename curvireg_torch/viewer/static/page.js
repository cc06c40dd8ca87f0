// Sends files to the server, and what the mouse, the fingers and the keys do on the photograph. The server draws.
(() => {
  // --- Files: chosen, dropped anywhere, or pasted.
  const address = () => location.pathname.replace(/\/$/, "") + "/upload";

  const isRig = (file) => /(^(images\.txt|scene_camera\.json)|\.csv)$/i.test(file.name);

  async function sendFiles(files) {
    for (const file of files.sort((a, b) => isRig(b) - isRig(a))) {  // what belongs to a rig comes after it
      const headers = { "x-file-name": encodeURIComponent(file.name) };
      await fetch(address(), { method: "POST", body: file, headers }).catch(() => {});  // the server shows the reason
    }
  }

  document.addEventListener("change", (event) => {
    if (event.target.type !== "file") return;
    sendFiles([...event.target.files]).then(() => (event.target.value = ""));  // so that the same file can be chosen again
  });
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("dropping");
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    sendFiles([...event.dataTransfer.files]);
  });
  addEventListener("paste", (event) => sendFiles([...event.clipboardData.files]));

  // --- The photograph: one pointer draws the box or moves the pose. Two pointers and the wheel zoom and pan where the
  // box is corrected; where the pose is, they change its distance and roll it.
  const pointers = new Map();
  let drawing = false, queued = null, pinch = null, scaled = null;

  const canvasOf = (target) => target.closest?.(".canvas");
  const isPose = (canvas) => canvas.dataset.mode === "pose";

  function send(type, event, canvas) {
    const frame = canvas.getBoundingClientRect();
    const reach = (event.pointerType === "touch" ? 22 : 10) / frame.width;
    const [x, y] = [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
    emitEvent("stage", { type, x, y, reach });
  }

  function scalePose(factor, roll) {
    if (!scaled) requestAnimationFrame(() => { emitEvent("stage", { type: "scale", ...scaled }); scaled = null; });
    scaled = { factor: (scaled?.factor ?? 1) * factor, roll: (scaled?.roll ?? 0) + roll };
  }

  function zoomTo(canvas, zoom, clientX, clientY) {
    const viewport = canvas.parentElement;
    const before = canvas.getBoundingClientRect();
    const [u, v] = [(clientX - before.left) / before.width, (clientY - before.top) / before.height];
    canvas.dataset.zoom = Math.min(Math.max(zoom, 1), 12);
    canvas.style.width = `${100 * canvas.dataset.zoom}%`;
    const after = canvas.getBoundingClientRect();
    viewport.scrollLeft += after.left + u * after.width - clientX;
    viewport.scrollTop += after.top + v * after.height - clientY;
  }

  const zoomOf = (canvas) => Number(canvas.dataset.zoom || 1);

  addEventListener("wheel", (event) => {
    const canvas = canvasOf(event.target);
    if (!canvas) return;
    if (isPose(canvas)) {
      const turn = event.deltaY || event.deltaX;  // Shift makes it horizontal
      event.shiftKey ? scalePose(1, turn / 20) : scalePose(Math.exp(-turn / 1500), 0);
    } else {
      if (event.shiftKey || (event.deltaY > 0 && zoomOf(canvas) === 1)) return;  // the page scrolls
      zoomTo(canvas, zoomOf(canvas) * Math.exp(-event.deltaY / 400), event.clientX, event.clientY);
    }
    event.preventDefault();
  }, { passive: false });

  addEventListener("click", (event) => {
    const name = event.target.dataset?.zoom;
    const canvas = document.querySelector(".canvas");
    if (!event.target.matches?.("button[data-zoom]") || !canvas) return;
    const frame = canvas.parentElement.getBoundingClientRect();
    const zoom = { in: zoomOf(canvas) * 1.5, out: zoomOf(canvas) / 1.5, fit: 1 }[name];
    zoomTo(canvas, zoom, frame.left + frame.width / 2, frame.top + frame.height / 2);
  });

  addEventListener("pointerdown", (event) => {
    const canvas = canvasOf(event.target);
    if (!canvas) return;
    pointers.set(event.pointerId, event);
    canvas.setPointerCapture(event.pointerId);
    if (pointers.size === 2) {
      if (drawing) send("cancel", event, canvas);
      drawing = false;
      pinch = spread();
    } else if (pointers.size === 1 && event.button === 0) {
      drawing = true;
      send("press", event, canvas);
      canvas.parentElement.focus({ preventScroll: true });
    }
    event.preventDefault();
  });

  function spread() {
    const [a, b] = [...pointers.values()];
    const [dx, dy] = [b.clientX - a.clientX, b.clientY - a.clientY];
    return {
      x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2,
      size: Math.hypot(dx, dy) || 1, angle: (Math.atan2(dy, dx) * 180) / Math.PI,
    };
  }

  addEventListener("pointermove", (event) => {
    const canvas = canvasOf(event.target), before = pointers.get(event.pointerId);
    if (!canvas || !before) return;
    pointers.set(event.pointerId, event);
    if (pinch && pointers.size === 2) {
      const now = spread();
      if (isPose(canvas)) {
        scalePose(now.size / pinch.size, ((now.angle - pinch.angle + 540) % 360) - 180);
      } else {
        zoomTo(canvas, (zoomOf(canvas) * now.size) / pinch.size, now.x, now.y);
        canvas.parentElement.scrollBy(pinch.x - now.x, pinch.y - now.y);
      }
      pinch = now;
    } else if (event.buttons === 4) {
      canvas.parentElement.scrollBy(before.clientX - event.clientX, before.clientY - event.clientY);
    } else if (drawing) {
      if (!queued) requestAnimationFrame(() => { if (queued && drawing) send("move", queued, canvas); queued = null; });
      queued = event;
    }
  });

  function release(event) {
    const canvas = canvasOf(event.target);
    if (!pointers.delete(event.pointerId) || !canvas) return;
    if (drawing && event.type === "pointerup") {
      send("move", event, canvas);
      send("release", event, canvas);
    } else if (drawing) {
      send("cancel", event, canvas);
    }
    drawing = false;
    queued = pinch = null;
  }
  addEventListener("pointerup", release);
  addEventListener("pointercancel", release);

  addEventListener("keydown", (event) => {
    const at = event.target;
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    let what = null;
    if (at.matches?.(".viewport")) {
      if (arrow) what = { type: "nudge", dx: arrow[0], dy: arrow[1], shift: event.shiftKey };
      else if (event.key === "Delete" || event.key === "Backspace") what = { type: "remove" };
    }
    if ((event.ctrlKey || event.metaKey) && event.key === "z" && !at.matches?.("input, textarea")) what = { type: "undo" };
    if (!what) return;
    event.preventDefault();
    emitEvent("stage", what);
  });

  // --- Sliders that only change how the layers look.
  addEventListener("input", (event) => {
    const property = event.target.dataset?.property;
    if (property) document.querySelector(".canvas").style.setProperty(property, event.target.value / 100);
  });

  // --- Texts to copy.
  addEventListener("click", (event) => {
    const button = event.target, source = button.dataset?.copy;
    if (!source) return;
    const element = document.querySelector(`[data-testid="${source}"]`), label = button.textContent;
    if (navigator.clipboard) {
      navigator.clipboard.writeText(element.textContent);
    } else {  // a page from another machine, without encryption
      element.closest("details").open = true;
      getSelection().selectAllChildren(element);
      document.execCommand("copy");
    }
    button.textContent = "copied";
    setTimeout(() => (button.textContent = label), 1500);
  });
})();
