/**
 * The 3-D view: the ground with the route on it, the robot, and a camera that follows it.
 *
 * Reads the shapes that web/a1/export.py took from MuJoCo's models (those that the course's films
 * show), and poses of the robot's bodies; draws with three.js. The view is turned by dragging or by
 * the arrow keys, and zoomed by the wheel, by two fingers or by + and -.
 */

import { inflateModule } from "../js/files.js";

const vendor = (name) => new URL(`vendor/${name}.gz`, import.meta.url);
const core = await inflateModule(vendor("three.core.min.js"));
const THREE = await import(
  await inflateModule(vendor("three.module.min.js"), { "./three.core.min.js": core })
);

/** Angle of the arrow keys, rad, and the factor of + and -. */
const TURN = 0.08;
const ZOOM = 1.12;
/** How steeply the camera may look down, rad, and how far away it may be, m. */
const STEEPEST = [0.05, 1.5];
const FARTHEST = [0.8, 14];
/** How fast the camera follows the robot: share of the way made in a second is 1 - exp(-this). */
const CHASE = 4;

export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {object} robot - `robot.json`
   */
  constructor(canvas, robot) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.05, 60);
    this.camera.up.set(0, 0, 1);
    /** Direction and distance of the camera from the robot. */
    this.orbit = { turn: -2.7, tilt: 0.55, distance: 2.4 };
    this.target = new THREE.Vector3();
    this.ground = new THREE.Group();
    this.scene.add(this.ground);
    this.addLights();
    this.coat = new THREE.MeshStandardMaterial({ roughness: 0.5 });
    this.bodies = this.addRobot(robot.shapes);
    this.listen();
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", () => this.setSky(dark.matches));
    this.setSky(dark.matches);
  }

  setSky(dark) {
    const sky = new THREE.Color(dark ? "#1b222b" : "#dbe6ef");
    this.scene.background = sky;
    this.scene.fog = new THREE.Fog(sky, 9, 24);
  }

  addLights() {
    this.scene.add(new THREE.HemisphereLight("#eef4fa", "#8a7f70", 1.7));
    this.sun = new THREE.DirectionalLight("#fff3df", 2.2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    const box = this.sun.shadow.camera;
    [box.left, box.right, box.bottom, box.top, box.near, box.far] = [-2, 2, -2, 2, 1, 12];
    this.sun.shadow.bias = -0.002;
    this.scene.add(this.sun, this.sun.target);
  }

  /** Return a group for each body of the robot, by MuJoCo's number of it. */
  addRobot(shapes) {
    const bodies = new Map();
    for (const shape of shapes) {
      if (!bodies.has(shape.body)) bodies.set(shape.body, new THREE.Group());
      const mesh = new THREE.Mesh(geometryOf(shape), shape.coat ? this.coat : materialOf(shape));
      putAt(mesh, shape);
      mesh.castShadow = true;
      bodies.get(shape.body).add(mesh);
    }
    this.scene.add(...bodies.values());
    return bodies;
  }

  /** Show another ground, as `shapes` in its own frame. */
  setGround(shapes) {
    for (const old of this.ground.children) {
      old.geometry.dispose();
      old.material.dispose();
    }
    this.ground.clear();
    const solid = shapes.filter((shape) => shape.type === "box" && shape.rgba[3] === 1);
    const boxes = new THREE.InstancedMesh(
      new THREE.BoxGeometry(2, 2, 2),
      new THREE.MeshStandardMaterial({ roughness: 0.95 }),
      solid.length,
    );
    const place = new THREE.Object3D();
    solid.forEach((shape, i) => {
      putAt(place, shape);
      place.scale.set(...shape.size);
      place.updateMatrix();
      boxes.setMatrixAt(i, place.matrix);
      boxes.setColorAt(i, colourOf(shape));
    });
    boxes.receiveShadow = true;
    boxes.frustumCulled = false;
    this.ground.add(boxes);
    for (const shape of shapes.filter((one) => !solid.includes(one))) {
      const mesh = new THREE.Mesh(geometryOf(shape), materialOf(shape));
      putAt(mesh, shape);
      this.ground.add(mesh);
    }
  }

  /** Colour the hull. */
  setCoat(colour) {
    this.coat.color.set(colour);
  }

  /**
   * Draw the robot between two states, and let the camera follow.
   *
   * @param {Pose} before
   * @param {Pose} after
   * @param {number} share - 0: before, 1: after
   * @param {number} seconds - Time since the last picture; Infinity: the camera jumps.
   */
  draw(before, after, share, seconds) {
    const turned = new THREE.Quaternion();
    for (const [id, group] of this.bodies) {
      const [p, q] = [3 * id, 4 * id];
      for (const [k, axis] of ["x", "y", "z"].entries()) {
        const [from, to] = [before.positions[p + k], after.positions[p + k]];
        group.position[axis] = from + share * (to - from);
      }
      setQuaternion(group.quaternion, before.rotations, q);
      setQuaternion(turned, after.rotations, q);
      group.quaternion.slerp(turned, share);
    }
    const trunk = this.bodies.get(1).position;
    this.target.lerp(trunk, 1 - Math.exp(-CHASE * seconds));
    this.sun.target.position.copy(trunk);
    this.sun.position.set(trunk.x - 2, trunk.y + 1.6, trunk.z + 5);
    const { turn, tilt, distance } = this.orbit;
    const reach = distance * Math.cos(tilt);
    this.camera.position.set(
      this.target.x + reach * Math.cos(turn),
      this.target.y + reach * Math.sin(turn),
      this.target.z + distance * Math.sin(tilt),
    );
    this.camera.lookAt(this.target);
    this.fit();
    this.renderer.render(this.scene, this.camera);
  }

  /** Follow the size of the canvas on the page. */
  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio, 2);
    if (this.size === `${width} ${height} ${ratio}`) return;
    this.size = `${width} ${height} ${ratio}`;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // The robot stays as wide on a phone as on a desk.
    this.camera.fov = width < height ? 60 : 45;
    this.camera.updateProjectionMatrix();
  }

  /** Turn the camera around the robot, and move it away by a factor. */
  move(turn, tilt, factor = 1) {
    const { orbit } = this;
    orbit.turn += turn;
    orbit.tilt = THREE.MathUtils.clamp(orbit.tilt + tilt, ...STEEPEST);
    orbit.distance = THREE.MathUtils.clamp(orbit.distance * factor, ...FARTHEST);
  }

  listen() {
    const { canvas } = this;
    const fingers = new Map();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? spread() : 0;
      const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (fingers.size === 1) this.move(-0.008 * dx, 0.008 * dy);
      else if (fingers.size === 2) this.move(0, 0, before / Math.max(spread(), 1));
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.move(0, 0, Math.exp(0.001 * event.deltaY));
      },
      { passive: false },
    );
    const keys = {
      ArrowLeft: [TURN, 0],
      ArrowRight: [-TURN, 0],
      ArrowUp: [0, TURN],
      ArrowDown: [0, -TURN],
      "+": [0, 0, 1 / ZOOM],
      "-": [0, 0, ZOOM],
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      this.move(...keys[event.key]);
    });
  }
}

/**
 * @typedef {object} Pose
 * @property {Float64Array} positions - Of all bodies, in the ground's frame, m.
 * @property {Float64Array} rotations - Their quaternions (w, x, y, z).
 */

/** Return where all bodies of an `A1Env` are. */
export function poseOf(env) {
  const positions = Float64Array.from(env.data.xpos);
  for (let i = 0; i < positions.length; i += 3) {
    positions[i] -= env.corner[0];
    positions[i + 1] -= env.corner[1];
  }
  return { positions, rotations: Float64Array.from(env.data.xquat) };
}

/** Return the shape in three.js; sizes are MuJoCo's half lengths and radii, along z. */
function geometryOf({ type, size: [a, b, c] }) {
  if (type === "box") return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
  if (type === "sphere") return new THREE.SphereGeometry(a, 16, 12);
  const round =
    type === "capsule"
      ? new THREE.CapsuleGeometry(a, 2 * b, 6, 12)
      : new THREE.CylinderGeometry(a, a, 2 * b, 32);
  return round.rotateX(Math.PI / 2);
}

function materialOf(shape) {
  const opacity = shape.rgba[3];
  const colour = { color: colourOf(shape), roughness: 0.7 };
  return new THREE.MeshStandardMaterial({ ...colour, opacity, transparent: opacity < 1 });
}

function colourOf({ rgba: [r, g, b] }) {
  return new THREE.Color().setRGB(r, g, b, THREE.SRGBColorSpace);
}

function putAt(object, { pos, quat = [1, 0, 0, 0] }) {
  object.position.set(...pos);
  setQuaternion(object.quaternion, quat, 0);
}

function setQuaternion(quaternion, wxyz, at) {
  quaternion.set(wxyz[at + 1], wxyz[at + 2], wxyz[at + 3], wxyz[at]);
}
