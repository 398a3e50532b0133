// Says once whether the browser draws with a graphics card, and how many meshes it draws whenever that changes. Sends the
// velocity that a hand asks for, as long as it holds a key, a gamepad's shoulder button, or the cap of a SpaceMouse.
(() => {
  const ADDRESS = `${location.origin.replace("http", "ws")}/devices`;
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
  const INTERVAL_MS = 40;
  const REPORT_INTERVAL_MS = 250;
  const MIN_MESH_INDICES = 36; // of a box; lines and letters are instances, too, with fewer
  const DEAD_ZONE = 0.15;
  const SPACE_MOUSE_FULL = 350; // counts at full deflection
  const REPORT_LIFETIME_MS = 150; // a device that was unplugged sends none
  const SHOULDER_BUTTONS = [4, 5];
  const VENDORS = [{ vendorId: 0x256f }, { vendorId: 0x046d }]; // 3Dconnexion, Logitech
  const KEYS = { KeyI: [0, 1], KeyK: [0, -1], KeyJ: [1, 1], KeyL: [1, -1], KeyU: [2, 1], KeyO: [2, -1] };
  const pressed = new Set();
  const mouse = { axes: [0, 0, 0, 0, 0, 0], at: -Infinity };
  let turning = false;
  let socket = null;
  let moving = false;

  const context = document.createElement("canvas").getContext("webgl");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  const renderer = names ? context.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  const say = (value) => {
    const report = new WebSocket(ADDRESS);
    report.onopen = () => {
      report.send(JSON.stringify(value));
      report.close();
    };
  };
  say(renderer !== "" && !SOFTWARE.test(renderer));

  // viser says nowhere when it has read and drawn a mesh. It draws the meshes of moving bodies as instances.
  const { clear, drawElementsInstanced } = WebGL2RenderingContext.prototype;
  let counted = 0; // since the last clear
  let drawn = 0; // most between two clears, since the last report
  let isNew = false;
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (mode, count, ...rest) {
    if (count >= MIN_MESH_INDICES) counted += 1;
    return drawElementsInstanced.call(this, mode, count, ...rest);
  };
  WebGL2RenderingContext.prototype.clear = function (mask) {
    drawn = Math.max(drawn, counted);
    counted = 0;
    isNew = true;
    return clear.call(this, mask);
  };
  let said = -1;
  setInterval(() => {
    if (!isNew) return; // a scene that does not change is not drawn
    const now = Math.max(drawn, counted);
    counted = 0;
    drawn = 0;
    isNew = false;
    if (now !== said) say(now);
    said = now;
  }, REPORT_INTERVAL_MS);

  const isTyping = () => /^(INPUT|TEXTAREA|SELECT)$/.test(document.activeElement?.tagName ?? "");
  const release = () => pressed.clear();
  addEventListener("keydown", (event) => {
    if (isTyping() || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.code === "KeyM" && navigator.hid && !event.repeat) {
      navigator.hid.requestDevice({ filters: VENDORS }).then(listen, () => {});
    }
    if (event.code in KEYS) pressed.add(event.code);
    turning = event.shiftKey;
  });
  addEventListener("keyup", (event) => {
    pressed.delete(event.code);
    turning = event.shiftKey;
  });
  addEventListener("blur", release);
  document.addEventListener("visibilitychange", release);

  // Reports of a SpaceMouse: 1 is the translation, with the rotation behind it in newer ones; 2 is the rotation.
  // Its axes: x to the right, y towards the hand, z down.
  const listen = (devices) => {
    for (const device of devices) {
      device.addEventListener("inputreport", ({ reportId, data }) => {
        if (reportId !== 1 && reportId !== 2) return;
        const first = reportId === 1 ? 0 : 3;
        const count = Math.min(Math.floor(data.byteLength / 2), 6 - first);
        for (let k = 0; k < count; k++) mouse.axes[first + k] = data.getInt16(2 * k, true) / SPACE_MOUSE_FULL;
        mouse.at = performance.now();
      });
      if (!device.opened) device.open().catch(() => {});
    }
  };
  navigator.hid?.getDevices().then(listen);

  // World axes, seen from behind the arm: x away from the hand, y to the left, z up. Shares of the full speed.
  const wanted = () => {
    const velocity = [0, 0, 0, 0, 0, 0];
    for (const code of pressed) velocity[KEYS[code][0] + (turning ? 3 : 0)] += KEYS[code][1];
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad || !SHOULDER_BUTTONS.some((button) => pad.buttons[button]?.pressed)) continue;
      const axes = pad.axes.map((share) => (Math.abs(share) > DEAD_ZONE ? share : 0));
      velocity[0] -= axes[1] ?? 0;
      velocity[1] -= axes[0] ?? 0;
      velocity[2] -= axes[3] ?? 0;
      velocity[5] -= axes[2] ?? 0;
    }
    if (performance.now() - mouse.at < REPORT_LIFETIME_MS) {
      const [x, y, z, a, b, c] = mouse.axes.map((share) => (Math.abs(share) > DEAD_ZONE ? share : 0));
      [-y, -x, -z, -b, -a, -c].forEach((share, k) => (velocity[k] += share));
    }
    return velocity.map((share) => Math.min(Math.max(share, -1), 1));
  };

  setInterval(() => {
    const velocity = wanted();
    const wasMoving = moving;
    moving = velocity.some((share) => share !== 0);
    if (!moving && !wasMoving) return; // the last message says zero
    if (!socket || socket.readyState > WebSocket.OPEN) {
      socket = new WebSocket(ADDRESS);
    } else if (socket.readyState === WebSocket.OPEN && socket.bufferedAmount === 0) {
      socket.send(JSON.stringify(velocity));
    }
  }, INTERVAL_MS);
})();
