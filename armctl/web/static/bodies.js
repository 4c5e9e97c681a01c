// The bodies of an arm: rounded links, a servo at each joint, fingers. Lengths are in metres, z is up.

import * as three from "/three.js";

const SERVO = [0.05, 0.032, 0.038];  // an AX-12A: along the link, across, along its axis
const LINK_RADIUS = 0.009;
const FINGER = 0.045;
const CLOSE = 1e-3;
// The arm that these bodies are the right size for, stretched.
const USUAL_REACH = 0.45;

export const vector = (point) => new three.Vector3(...point);

// Turns a cylinder's or capsule's axis (y) to a direction.
const along = (direction) => new three.Quaternion().setFromUnitVectors(new three.Vector3(0, 1, 0), direction.clone().normalize());

// Something across an axis, nearest to what is wanted.
export function across(axis, wanted) {
  for (const some of [wanted, new three.Vector3(1, 0, 0), new three.Vector3(0, 1, 0)]) {
    const part = some.clone().addScaledVector(axis, -some.dot(axis));
    if (part.length() > 0.3 * some.length() && part.length() > CLOSE) return part.normalize();
  }
  return null;
}

// An arm of bodies. `description`: `axes`, a `place_m` and a `direction` for each joint at position 0, in the base
// frame; `tool_m` there; `gripper`, or null: which joint it is, and where it is open and closed.
export class Bodies {
  constructor({ axes, tool_m, gripper, floor_m }, materials) {
    const places = axes.map(({ place_m }) => vector(place_m)), directions = axes.map(({ direction }) => vector(direction).normalize());
    const tool = vector(tool_m), stretched = [...places, tool].reduce((sum, place, i, all) => sum + (i ? place.distanceTo(all[i - 1]) : 0), 0);
    const size = Math.max(0.7, stretched / USUAL_REACH);
    this.root = new three.Group();
    this.directions = directions;
    this.turning = [];
    let parent = this.root, origin = new three.Vector3();
    this.column(new three.Vector3(0, 0, floor_m), places[0], 2.2 * LINK_RADIUS * size, materials.servo);
    places.forEach((place, i) => {
      const before = i ? places[i - 1] : new three.Vector3(0, 0, floor_m), after = places[i + 1] || tool;
      this.servo(parent, place.clone().sub(origin), directions[i], place.clone().sub(before), size, materials.servo);
      const joint = new three.Group();
      joint.position.copy(place).sub(origin);
      parent.add(joint);
      this.turning.push(joint);
      this.link(joint, after.clone().sub(place), i === places.length - 1 ? FINGER : 0, size, materials.link);
      [parent, origin] = [joint, place];
    });
    this.hand(parent, tool.clone().sub(origin), directions.at(-1), gripper, size, materials);
    this.tip = new three.Object3D();
    this.tip.position.copy(tool).sub(origin);
    parent.add(this.tip);
  }

  add(parent, geometry, material, position, turned) {
    const mesh = new three.Mesh(geometry, material);
    mesh.position.copy(position);
    if (turned) mesh.quaternion.copy(turned);
    parent.add(mesh);
    return mesh;
  }

  column(from, to, radius, material) {
    const way = to.clone().sub(from);
    if (way.length() < CLOSE) return;
    this.add(this.root, new three.CylinderGeometry(radius, 1.6 * radius, way.length(), 32), material, from.clone().addScaledVector(way, 0.5), along(way));
  }

  servo(parent, at, axis, from, size, material) {
    const length = across(axis, from);
    const turned = new three.Quaternion().setFromRotationMatrix(new three.Matrix4().makeBasis(length, axis.clone().cross(length), axis));
    this.add(parent, new three.BoxGeometry(...SERVO.map((side) => side * size)), material, at.clone().addScaledVector(length, -0.012 * size), turned);
  }

  link(joint, way, short, size, material) {
    const length = way.length() - short * size;
    if (length < CLOSE) return;
    const geometry = new three.CapsuleGeometry(LINK_RADIUS * size, length, 6, 16);
    this.add(joint, geometry, material, way.clone().setLength(length / 2), along(way));
  }

  // Two fingers whose tips hold the tool's point between them.
  hand(parent, tip, axis, gripper, size, { link, servo }) {
    const forward = tip.length() > CLOSE ? tip.clone().normalize() : across(axis, new three.Vector3(1, 0, 0));
    const aside = across(forward, axis) || across(forward, new three.Vector3(0, 0, 1));
    const turned = new three.Quaternion().setFromRotationMatrix(new three.Matrix4().makeBasis(aside, forward, aside.clone().cross(forward)));
    const length = FINGER * size, width = 0.006 * size;
    this.add(parent, new three.BoxGeometry(0.05 * size, 0.008 * size, 0.022 * size), servo, tip.clone().addScaledVector(forward, -length), turned);
    this.fingers = [-1, 1].map((side) => {
      const mesh = this.add(parent, new three.BoxGeometry(width, length, 0.018 * size), link, tip.clone().addScaledVector(forward, -length / 2), turned);
      return { mesh, at: mesh.position.clone(), aside: aside.clone().multiplyScalar(side), least: width / 2 + 0.001 };
    });
    [this.gripper, this.reach] = [gripper, 0.018 * size];
    this.grip(0.5);
  }

  grip(open) {
    for (const { mesh, at, aside, least } of this.fingers) mesh.position.copy(at).addScaledVector(aside, least + this.reach * Math.min(Math.max(open, 0), 1));
  }

  // Where its foot, its joints and its tool are [m].
  places() {
    this.root.updateMatrixWorld(true);
    return [this.root, ...this.turning, this.tip].map((part) => part.getWorldPosition(new three.Vector3()));
  }

  // Joint positions [rad]; those beyond the chain may follow.
  pose(q) {
    this.turning.forEach((joint, i) => joint.quaternion.setFromAxisAngle(this.directions[i], q[i]));
    if (this.gripper) this.grip((q[this.gripper.index] - this.gripper.closed_rad) / (this.gripper.open_rad - this.gripper.closed_rad));
  }
}
