// Numbers of a page: decoding of arrays, and the kinematics of a tree.
//
// A frame is seven numbers: position, then quaternion x y z w. `at` is the index of its
// first number. The kinematics are those of newton_qd.physics.reference.
"use strict";

const NQD = {};

(function () {
  const FREE = 0, REVOLUTE = 1;
  const TYPES = {
    float32: Float32Array, int16: Int16Array, int32: Int32Array, uint8: Uint8Array,
  };

  // Returns {shape, data} of an array that Python encoded. int16 has a scale and an
  // offset for each component of the last axis.
  NQD.decode = function (array) {
    const text = atob(array.data);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const raw = new TYPES[array.type](bytes.buffer);
    if (!array.scale) return { shape: array.shape, data: raw };
    const n = array.scale.length;
    const data = new Float32Array(raw.length);
    for (let i = 0; i < raw.length; i++) {
      data[i] = raw[i] * array.scale[i % n] + array.offset[i % n];
    }
    return { shape: array.shape, data: data };
  };

  // Writes the vector (x, y, z) turned by the quaternion at b[at] to out[to].
  function turn(b, at, x, y, z, out, to) {
    const qx = b[at], qy = b[at + 1], qz = b[at + 2], qw = b[at + 3];
    const tx = 2 * (qy * z - qz * y);
    const ty = 2 * (qz * x - qx * z);
    const tz = 2 * (qx * y - qy * x);
    out[to] = x + qw * tx + qy * tz - qz * ty;
    out[to + 1] = y + qw * ty + qz * tx - qx * tz;
    out[to + 2] = z + qw * tz + qx * ty - qy * tx;
  }

  const moved = new Float64Array(3);

  // Writes frame b, given in frame a, in the frame of a. out may be a or b.
  function compose(a, i, b, j, out, k) {
    turn(a, i + 3, b[j], b[j + 1], b[j + 2], moved, 0);
    const ax = a[i + 3], ay = a[i + 4], az = a[i + 5], aw = a[i + 6];
    const bx = b[j + 3], by = b[j + 4], bz = b[j + 5], bw = b[j + 6];
    out[k] = a[i] + moved[0];
    out[k + 1] = a[i + 1] + moved[1];
    out[k + 2] = a[i + 2] + moved[2];
    out[k + 3] = aw * bx + bw * ax + ay * bz - az * by;
    out[k + 4] = aw * by + bw * ay + az * bx - ax * bz;
    out[k + 5] = aw * bz + bw * az + ax * by - ay * bx;
    out[k + 6] = aw * bw - ax * bx - ay * by - az * bz;
  }

  function inverse(a) {
    const out = new Float64Array([0, 0, 0, -a[3], -a[4], -a[5], a[6]]);
    turn(out, 3, -a[0], -a[1], -a[2], out, 0);
    return out;
  }

  NQD.turn = turn;
  NQD.compose = compose;

  // Prepares a tree: {parent, kind, qStart, axis, parentFrame, childFrame}.
  NQD.tree = function (drawing) {
    return {
      size: drawing.parent.length,
      nq: drawing.nq,
      parent: drawing.parent,
      kind: drawing.joint_kind,
      qStart: drawing.q_start,
      axis: drawing.joint_axis,
      parentFrame: drawing.parent_frame,
      childInverse: drawing.child_frame.map(inverse),
    };
  };

  const motion = new Float64Array(7);

  // Writes the world frames of all bodies at the coordinates q[at] to out (7 each).
  NQD.kinematics = function (tree, q, at, out) {
    for (let i = 0; i < tree.size; i++) {
      const from = at + tree.qStart[i];
      const axis = tree.axis[i];
      motion.fill(0);
      motion[6] = 1;
      if (tree.kind[i] === FREE) {
        let norm = 0;
        for (let c = 3; c < 7; c++) norm += q[from + c] * q[from + c];
        norm = Math.sqrt(norm);
        for (let c = 0; c < 3; c++) motion[c] = q[from + c];
        for (let c = 3; c < 7; c++) motion[c] = q[from + c] / norm;
      } else if (tree.kind[i] === REVOLUTE) {
        const sine = Math.sin(q[from] / 2);
        for (let c = 0; c < 3; c++) motion[3 + c] = sine * axis[c];
        motion[6] = Math.cos(q[from] / 2);
      } else {
        for (let c = 0; c < 3; c++) motion[c] = axis[c] * q[from];
      }
      compose(tree.parentFrame[i], 0, motion, 0, out, 7 * i);
      if (tree.parent[i] >= 0) compose(out, 7 * tree.parent[i], out, 7 * i, out, 7 * i);
      compose(out, 7 * i, tree.childInverse[i], 0, out, 7 * i);
    }
    return out;
  };

  // Writes coordinates between two frames. Quaternions take the shorter way.
  NQD.between = function (tree, q, first, second, share, out) {
    for (let c = 0; c < tree.nq; c++) {
      out[c] = q[first + c] + share * (q[second + c] - q[first + c]);
    }
    for (let i = 0; i < tree.size; i++) {
      if (tree.kind[i] !== FREE) continue;
      const s = tree.qStart[i] + 3;
      let dot = 0;
      for (let c = s; c < s + 4; c++) dot += q[first + c] * q[second + c];
      if (dot >= 0) continue;
      for (let c = s; c < s + 4; c++) {
        out[c] = (1 - share) * q[first + c] - share * q[second + c];
      }
    }
    return out;
  };

  // Returns a new element. Text is never read as HTML.
  NQD.element = function (tag, parent, options) {
    const made = document.createElement(tag);
    const given = options || {};
    if (given.text !== undefined) made.textContent = given.text;
    if (given.name !== undefined) made.className = given.name;
    if (given.title !== undefined) made.title = given.title;
    if (given.type !== undefined) made.type = given.type;
    if (given.role !== undefined) made.setAttribute("role", given.role);
    // what a screen reader says of a picture or a symbol
    if (given.label !== undefined) made.setAttribute("aria-label", given.label);
    if (parent) parent.appendChild(made);
    return made;
  };

  // Colours that people with colour blindness can tell apart (Okabe and Ito 2008).
  NQD.palette = [
    "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442",
  ];

  NQD.data = function () {
    return JSON.parse(document.getElementById("data").textContent);
  };
})();
