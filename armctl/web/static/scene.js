// The arm in space: bodies on its joints, the posture that is asked for as a ghost, floor, lines and paths. Lengths are
// in metres, z is up. A picture is drawn only when something in it has changed.

import { across, Bodies, vector } from "/bodies.js";
import * as three from "/three.js";

// A ball is grasped within this distance; a pointer that went no farther than that has clicked [pixels].
const [GRASP_PX, CLICK_PX] = [16, 5];
// A new posture is reached by the time the next one is expected.
const GLIDE_MS = 100;
// A browser that draws slower than this is not asked to glide for a while: a click comes first. The mean time between two
// pictures follows each new one by a share: one that comes late, as the first ones do, is not slowness yet.
const [SLOW_MS, REST_MS, SHARE] = [50, 3000, 0.1];
// Of the picture, what a view of the arm fills at first, or of paths; a joint farther out leaves it.
const [FILLED, OF_PATHS, EDGE] = [0.8, 0.9, 0.96];
// Where a view of the arm looks from. Where this share of how far off it is would do, it comes nearer.
const [FROM, SMALL] = [new three.Vector3(0.62, -0.72, 0.5), 0.75];
// The curve that comes and goes.
const PASSING = "trail";
// Of the reach: what is in sight at least, to each side of the base and above.
const LEAST_SEEN = [0.3, 0.6];

// A colour, or that of the page by its name.
const css = (colour) => colour.startsWith("--") ? getComputedStyle(document.body).getPropertyValue(colour).trim() : colour;

export class ArmView {
  // Draws into an element, which has a size of its own.
  constructor(element) {
    this.element = element;
    this.renderer = new three.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 1.5));
    element.replaceChildren(this.renderer.domElement);
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(35, 1, 0.01, 20);
    this.camera.up.set(0, 0, 1);
    this.controls = new three.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = 0.55 * Math.PI;
    this.controls.addEventListener("change", () => {
      this.turned ||= !this.framing;
      this.redraw();
    });
    // Told where a place of the picture is that was clicked, or that one of the balls was led there.
    [this.picked, this.led, this.dragged] = [null, null, null];
    this.hear(this.renderer.domElement);
    this.sun = new three.DirectionalLight(0xffffff, 1.6);
    this.sun.position.set(0.6, -1, 2);
    this.scene.add(new three.HemisphereLight(0xffffff, 0x8899aa, 1.9), this.sun);
    this.materials = {
      servo: new three.MeshLambertMaterial(), link: new three.MeshLambertMaterial(),
      ghost: new three.MeshLambertMaterial({ transparent: true, opacity: 0.28, depthWrite: false }),
    };
    this.curves = new Map();
    [this.dots, this.ball, this.dotted] = [new three.Group(), new three.SphereGeometry(0.004, 16, 12), new three.MeshBasicMaterial()];
    this.target = new three.Mesh(new three.SphereGeometry(0.006, 16, 12), new three.MeshBasicMaterial());
    this.target.visible = false;
    this.scene.add(this.dots, this.target);
    this.shown = this.wanted = null;
    // Until when nothing glides; the mean time between two pictures of a glide, and when the last of one was drawn.
    [this.rested, this.gap_ms, this.drawn] = [0, 0, 0];
    this.paint();
    new ResizeObserver(() => this.resize()).observe(element);
  }

  // The arm to draw; see `Bodies`.
  setArm(arm) {
    const reach = [...arm.axes.map(({ place_m }) => vector(place_m)), vector(arm.tool_m)];
    this.reach = reach.reduce((sum, place, i) => sum + (i ? place.distanceTo(reach[i - 1]) : 0), 0);
    // How far the stretched arm comes, turned about its second joint, on the floor.
    const [foot, ...beyond] = reach.slice(Math.min(1, reach.length - 2));
    const arm_m = beyond.reduce((sum, place, i) => sum + place.distanceTo(i ? beyond[i - 1] : foot), 0);
    this.around = Math.hypot(foot.x, foot.y) + Math.sqrt(Math.max(0, arm_m ** 2 - (foot.z - arm.floor_m) ** 2));
    this.floor = [[0, 0, arm.floor_m], this.reach + 0.05, 0.05];  // its middle, how far it goes, its squares
    this.bodies = new Bodies(arm, this.materials);
    this.ghost = new Bodies(arm, { servo: this.materials.ghost, link: this.materials.ghost });
    this.probe = new Bodies(arm, this.materials);
    this.ghost.root.visible = false;
    this.shown = this.wanted = null;
    this.scene.add(this.bodies.root, this.ghost.root);
    this.paint();
    this.look();
  }

  // What is to be in sight: the arm, where it is to be, the lines, and a part of the floor.
  shownPlaces() {
    const [aside, above] = LEAST_SEEN.map((share) => share * this.reach), [[x, y, z]] = this.floor;
    const places = [...this.places(), ...[-1, 1].flatMap((side) => [[x + side * aside, y, z], [x, y + side * aside, z]]).map(vector), new three.Vector3(x, y, z + above)];
    for (const [name, { line }] of this.curves) {
      const { position } = line.geometry.attributes;
      for (let i = 0; line.visible && name !== PASSING && i < position.count; i++) places.push(new three.Vector3().fromBufferAttribute(position, i));
    }
    return places;
  }

  // From the front and aside, all that is in the picture. It stays so until somebody turns the picture.
  look() {
    this.turned = false;
    this.frame(this.fitted(this.shownPlaces(), FROM, FILLED));
  }

  // Where the joints and the tool are, and are to be.
  places() {
    return [this.bodies, this.ghost].filter(({ root }) => root.visible).flatMap((bodies) => bodies.places());
  }

  // Where to look at, from which direction and how far off, so that places [m], which get lost, fill a share of the picture.
  fitted(places, from, share) {
    const middle = new three.Box3().setFromPoints(places).getCenter(new three.Vector3());
    const back = from.clone().normalize(), side = this.camera.up.clone().cross(back).normalize(), high = back.clone().cross(side);
    const tall = share * Math.tan(this.camera.fov * Math.PI / 360), wide = tall * this.camera.aspect;
    const far = Math.max(0.05, ...places.map((place) => {
      place.sub(middle);
      return place.dot(back) + Math.max(Math.abs(place.dot(side)) / wide, Math.abs(place.dot(high)) / tall);
    }));
    return { middle, back, far };
  }

  frame({ middle, back, far }) {
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(back, this.far = far);
    this.framing = true;
    this.controls.update();
    this.framing = false;
    this.redraw();
  }

  // Keep the arm in the picture, and large in it, if nobody has turned it.
  follow() {
    if (this.turned) return;
    this.camera.updateMatrixWorld();
    const leaves = ({ x, y }) => Math.max(Math.abs(x), Math.abs(y)) > EDGE;
    if (this.places().some((place) => leaves(place.project(this.camera))) || this.fitted(this.shownPlaces(), FROM, FILLED).far < SMALL * this.far) this.look();
  }

  // The colours of the page.
  paint() {
    this.materials.servo.color.set(css("--servo"));
    this.materials.link.color.set(css("--link"));
    this.materials.ghost.color.set(css("--blue"));
    this.target.material.color.set(css("--red"));
    for (const { line, colour } of this.curves.values()) line.material.color.set(css(colour));
    if (this.dotColour) this.dotted.color.set(css(this.dotColour));
    if (this.grid) this.scene.remove(this.grid);
    if (this.floor) {
      const [[x, y, z], half, square] = this.floor, count = 2 * Math.ceil(half / square);
      this.grid = new three.GridHelper(count * square, count, css(this.bodies ? "--rule" : "--edge"), css("--edge"));
      if (this.around) this.grid.add(this.circle(this.around));
      this.grid.rotation.x = Math.PI / 2;
      this.grid.position.set(x, y, z);
      this.scene.add(this.grid);
    }
    this.redraw();
  }

  circle(radius) {
    const points = Array.from({ length: 97 }, (_, i) => new three.Vector3(radius * Math.cos(i * Math.PI / 48), 0, radius * Math.sin(i * Math.PI / 48)));
    return new three.Line(new three.BufferGeometry().setFromPoints(points), new three.LineBasicMaterial({ color: css("--rule") }));
  }

  // Where the joints are [rad]; `glide`: on the way there from what is shown.
  pose(q, glide = false) {
    const now = performance.now();
    if (glide && this.shown && now > this.rested) [this.from, this.wanted, this.begun] = [this.shown, q, now];
    else {
      const first = !this.shown;
      [this.from, this.shown, this.wanted, this.begun] = [q, q, q, now - GLIDE_MS];
      if (first) {
        this.bodies.pose(q);
        this.look();
      }
    }
    this.redraw();
  }

  // Where the joints are to be [rad]; null: as they are.
  aim(q) {
    if (q) this.ghost.pose(q);
    this.ghost.root.visible = q !== null;
    if (q) this.follow();
    this.redraw();
  }

  // Where the tool would be [m], with the joints there [rad].
  toolAt(q) {
    this.probe.pose(q);
    this.probe.root.updateMatrixWorld(true);
    return this.probe.tip.getWorldPosition(new three.Vector3()).toArray();
  }

  // Points [m] of which each is a ball, in a colour of the page.
  balls(points, colour) {
    this.dots.clear();
    for (const point of points) {
      const ball = new three.Mesh(this.ball, this.dotted);
      ball.position.set(...point);
      this.dots.add(ball);
    }
    this.dotColour = colour;
    this.dotted.color.set(css(colour));
    this.redraw();
  }

  // A place [m] that is aimed at; null: none.
  aimAt(place) {
    this.target.visible = place !== null;
    if (place) this.target.position.set(...place);
    this.redraw();
  }

  // Where the ray through a place of the picture meets a plane; null: nowhere before the eye, or far too slantingly.
  under({ clientX, clientY }, through, normal) {
    const { left, top, width, height } = this.renderer.domElement.getBoundingClientRect(), eye = this.camera.position;
    const seen = new three.Vector3(2 * (clientX - left) / width - 1, 1 - 2 * (clientY - top) / height, 0.5).unproject(this.camera).sub(eye).normalize();
    const far = through.clone().sub(eye).dot(normal) / seen.dot(normal);
    return Math.abs(seen.dot(normal)) > 0.02 && far > 0 ? eye.clone().addScaledVector(seen, far) : null;
  }

  // The ball under a finger; -1: none.
  ballAt({ clientX, clientY }) {
    const { left, top, width, height } = this.renderer.domElement.getBoundingClientRect();
    return this.dots.children.findIndex(({ position }) => {
      const { x, y } = position.clone().project(this.camera);
      return Math.hypot((x + 1) / 2 * width + left - clientX, (1 - y) / 2 * height + top - clientY) < GRASP_PX;
    });
  }

  // A ball follows whoever drags it, in a plane across the eye's direction; a click that drags nothing picks a place.
  hear(canvas) {
    let began = null;
    canvas.addEventListener("pointerdown", (event) => {
      began = event;
      const index = this.led ? this.ballAt(event) : -1;
      if (index < 0) return;
      this.dragged = { index, ball: this.dots.children[index], normal: this.camera.getWorldDirection(new three.Vector3()) };
      this.controls.enabled = false;
      canvas.setPointerCapture(event.pointerId);
    }, { capture: true });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.dragged) {
        canvas.style.cursor = this.picked ? "crosshair" : this.led && this.ballAt(event) >= 0 ? "grab" : "";
        return;
      }
      const place = this.under(event, this.dragged.ball.position, this.dragged.normal);
      if (place) this.dragged.ball.position.copy(place);
      this.redraw();
    });
    canvas.addEventListener("pointercancel", () => this.drop());
    canvas.addEventListener("pointerup", (event) => {
      const still = began && Math.hypot(event.clientX - began.clientX, event.clientY - began.clientY) < CLICK_PX, dragged = this.drop();
      if (dragged && !still) this.led(dragged.index, dragged.ball.position.toArray());
      else if (still && this.picked) this.picked((through, normal) => this.under(event, vector(through), vector(normal))?.toArray() ?? null);
    });
  }

  drop() {
    const dragged = this.dragged;
    [this.dragged, this.controls.enabled] = [null, true];
    return dragged;
  }

  // Curves by other names are no longer shown.
  keep(names) {
    for (const [name, { line }] of this.curves) line.visible &&= names.includes(name);
    this.redraw();
  }

  // A path of points [m] by a name, in a colour of the page; none where there are fewer than two.
  curve(name, points, colour, dashed = false) {
    let known = this.curves.get(name);
    if (!known) {
      const material = dashed ? new three.LineDashedMaterial({ dashSize: 0.008, gapSize: 0.005 }) : new three.LineBasicMaterial();
      known = { line: new three.Line(new three.BufferGeometry(), material), colour };
      material.color.set(css(colour));
      known.line.frustumCulled = false;
      this.scene.add(known.line);
      this.curves.set(name, known);
    }
    known.line.visible = points.length > 1;
    known.line.geometry.dispose();
    known.line.geometry = new three.BufferGeometry().setFromPoints(points.map(vector));
    if (dashed) known.line.computeLineDistances();
    this.redraw();
  }

  // Paths [points, colour, dashed] alone, as near as all of them are in sight, over squares of 10 mm.
  paths(some) {
    this.resize();
    for (const { line } of this.curves.values()) line.visible = false;
    some.forEach(([points, colour, dashed], i) => this.curve(`${colour} ${i}`, points, colour, dashed));
    const places = some.flatMap(([points]) => points.map(vector)), longest = some.map(([points]) => points).sort((a, b) => b.length - a.length)[0];
    const box = new three.Box3().setFromPoints(places), { x, y } = box.getCenter(new three.Vector3());
    this.floor = [[x, y, box.min.z], box.getSize(new three.Vector3()).length() / 2, 0.01];
    // From aside and above of the way that the longest one leads.
    const way = across(this.camera.up, vector(longest.at(-1)).sub(vector(longest[0]))) ?? new three.Vector3(0, 1, 0);
    this.frame(this.fitted(places, way.cross(this.camera.up).addScaledVector(this.camera.up, 0.6), OF_PATHS));
    this.paint();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.bodies && !this.turned) this.look();
    this.redraw();
  }

  redraw() {
    if (!this.waiting) this.waiting = requestAnimationFrame(() => this.draw());
  }

  // Go on with a glide, if the browser can.
  pace(gliding) {
    const now = performance.now();
    if (this.drawn) this.gap_ms += SHARE * (now - this.drawn - this.gap_ms);
    this.drawn = gliding ? now : 0;
    if (this.gap_ms > SLOW_MS) [this.rested, this.gap_ms] = [now + REST_MS, 0];
    if (gliding) this.redraw();
  }

  draw() {
    this.waiting = 0;
    if (!this.element.clientWidth) return;
    if (this.bodies && this.wanted) {
      const share = Math.min(1, (performance.now() - this.begun) / GLIDE_MS);
      this.shown = this.wanted.map((q, i) => this.from[i] + share * (q - this.from[i]));
      this.bodies.pose(this.shown);
      this.follow();
      this.pace(share < 1);
    }
    this.renderer.render(this.scene, this.camera);
    this.element.dataset.frames = Number(this.element.dataset.frames || 0) + 1;
  }
}
