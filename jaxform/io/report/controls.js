// Pointer and keyboard: they turn, move and zoom the view, and read a place of the part.

const SLOW = 4; // pixels, that a click may be apart from where it began

class Controls {
  // `redraw` is called when the view has changed, `read` with what was picked.
  constructor(view, redraw, read) {
    Object.assign(this, { view, redraw, read, down: new Map(), moved: 0 });
    this.pointer();
    this.keys();
  }

  turn(x, y) {
    const { view } = this;
    view.azimuth -= view.up * x;
    view.elevation = clamp(view.elevation + y, -1.57, 1.57);
    this.redraw();
  }

  zoom(factor) {
    this.view.zoom = clamp(this.view.zoom * factor, 0.2, 60);
    this.redraw();
  }

  move(x, y) {
    const { view } = this,
      scale = 2 / (view.canvas.clientHeight * view.zoom);
    view.pan[0] += x * scale;
    view.pan[1] -= y * scale;
    this.redraw();
  }

  home() {
    this.view.home();
    this.redraw();
  }

  pick(x, y) {
    const found = this.view.pick(x, y);
    if (found) this.read(found);
  }

  pointer() {
    const { canvas } = this.view,
      { down } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      if (down.size === 1) this.moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.end(event));
  }

  wheel(event) {
    event.preventDefault();
    this.zoom(Math.exp(-0.0015 * event.deltaY));
  }

  drag(event) {
    const { down } = this,
      before = down.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before[0], event.clientY - before[1]],
      apart = this.apart();
    down.set(event.pointerId, [event.clientX, event.clientY]);
    this.moved += Math.abs(x) + Math.abs(y);
    if (down.size === 2) {
      this.zoom(this.apart() / (apart || 1));
      this.move(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons & 6) this.move(x, y);
    else if (this.moved > SLOW) this.turn(0.008 * x, 0.008 * y);
  }

  // Of two fingers.
  apart() {
    const [one, other] = [...this.down.values()];
    return other ? Math.hypot(one[0] - other[0], one[1] - other[1]) : 0;
  }

  end(event) {
    const still = this.down.size === 1 && this.moved <= SLOW;
    if (!this.down.delete(event.pointerId) || !still || event.type !== "pointerup" || event.button !== 0) return;
    const box = this.view.canvas.getBoundingClientRect();
    this.pick(event.clientX - box.left, event.clientY - box.top);
  }

  keys() {
    const actions = {
      ArrowLeft: () => this.turn(-0.12, 0),
      ArrowRight: () => this.turn(0.12, 0),
      ArrowUp: () => this.turn(0, -0.12),
      ArrowDown: () => this.turn(0, 0.12),
      "+": () => this.zoom(1.15),
      "=": () => this.zoom(1.15),
      "-": () => this.zoom(1 / 1.15),
      0: () => this.home(),
      Home: () => this.home(),
      Enter: () => this.pickMiddle(),
    };
    this.view.canvas.addEventListener("keydown", (event) => {
      const action = !(event.ctrlKey || event.metaKey || event.altKey) && actions[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
  }

  pickMiddle() {
    const { panes } = this.view,
      { left, width, height } = panes[panes.length - 1].seen;
    this.pick(left + width / 2, height / 2);
  }
}
