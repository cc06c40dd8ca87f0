// Sends files to the server, and what the mouse, the fingers and the keys do on the photograph. The server draws.
(() => {
  // --- Files: chosen, dropped anywhere, or pasted.
  const address = () => location.pathname.replace(/\/$/, "") + "/upload";

  async function sendFiles(files) {
    for (const file of files) {
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

  // --- The photograph: one pointer draws, two zoom and pan, the wheel zooms, the middle button pans.
  const pointers = new Map();
  let drawing = false, queued = null, pinch = null;

  const canvasOf = (target) => target.closest?.(".canvas");

  function send(type, event, canvas) {
    const frame = canvas.getBoundingClientRect();
    const reach = (event.pointerType === "touch" ? 22 : 10) / frame.width;
    const [x, y] = [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
    emitEvent("stage", { type, x, y, reach });
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
    if (!canvas || event.shiftKey || (event.deltaY > 0 && zoomOf(canvas) === 1)) return;  // the page scrolls
    event.preventDefault();
    zoomTo(canvas, zoomOf(canvas) * Math.exp(-event.deltaY / 400), event.clientX, event.clientY);
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
    return {
      x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2,
      size: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) || 1,
    };
  }

  addEventListener("pointermove", (event) => {
    const canvas = canvasOf(event.target), before = pointers.get(event.pointerId);
    if (!canvas || !before) return;
    pointers.set(event.pointerId, event);
    if (pinch && pointers.size === 2) {
      const now = spread();
      zoomTo(canvas, (zoomOf(canvas) * now.size) / pinch.size, now.x, now.y);
      canvas.parentElement.scrollBy(pinch.x - now.x, pinch.y - now.y);
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
    const step = event.shiftKey ? 10 : 1;
    const arrow = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
    const control = event.ctrlKey || event.metaKey;
    const key = event.key.toLowerCase();
    let what = null;
    if (at.matches?.(".viewport")) {
      if (arrow) what = { type: "nudge", dx: arrow[0], dy: arrow[1], resize: event.altKey };
      else if (event.key === "Delete" || event.key === "Backspace") what = { type: "remove" };
    }
    if (control && !at.matches?.("input, textarea")) {
      if (key === "y" || (key === "z" && event.shiftKey)) what = { type: "redo" };
      else if (key === "z") what = { type: "undo" };
    }
    if (!what) return;
    event.preventDefault();
    emitEvent("stage", what);
  });

  // --- Sliders that only change how the layers look.
  addEventListener("input", (event) => {
    const property = event.target.dataset?.property;
    if (property) document.querySelector(".canvas").style.setProperty(property, event.target.value / 100);
  });

  // --- The map of directions has fields beside it; its picture, which NiceGUI leaves without a text, says nothing more.
  const describe = () => document.querySelectorAll("img:not([alt])").forEach((image) => (image.alt = ""));
  new MutationObserver(describe).observe(document, { childList: true, subtree: true });
})();
