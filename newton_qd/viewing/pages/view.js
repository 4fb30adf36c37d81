// The three-dimensional view: worlds of one robot, the ground, a camera.
//
// Every shape is one instanced mesh with an instance for each world, so that the work
// of a frame grows slowly with the number of worlds.
"use strict";

(function () {
  const FIELD = 40; // vertical field of view of the camera [degrees]
  const TRAIL = 2000; // most points of a trail
  const ARROWS = 64; // most contact impulses of a world

  const GRID = `
    varying vec2 vGrid;
    uniform float gridStep;
    uniform vec3 gridMinor, gridMajor;
    float gridLine(float step, float pixels) {
      vec2 at = vGrid / step, size = fwidth(at);
      vec2 away = abs(fract(at - 0.5) - 0.5) / size;
      float line = 1.0 - clamp(min(away.x, away.y) - 0.5 * pixels + 0.5, 0.0, 1.0);
      return line * clamp(1.0 - 3.0 * max(size.x, size.y), 0.0, 1.0);
    }
  `;
  const GRID_LINES = `
    diffuseColor.rgb = mix(diffuseColor.rgb, gridMinor, gridLine(gridStep, 1.0));
    diffuseColor.rgb = mix(diffuseColor.rgb, gridMajor, gridLine(5.0 * gridStep, 2.0));
  `;

  const THEMES = {
    light: { sky: "#e8edf2", ground: "#dfe5ea", minor: "#a3afba", major: "#66747f" },
    dark: { sky: "#12161b", ground: "#1a2027", minor: "#46525e", major: "#7d8b99" },
  };

  function geometry(shape) {
    const s = shape.size;
    if (shape.kind === "sphere") return new THREE.SphereGeometry(s[0], 32, 20);
    if (shape.kind === "box") {
      return new THREE.BoxGeometry(2 * s[0], 2 * s[1], 2 * s[2]);
    }
    if (shape.kind === "mesh") {
      const made = new THREE.BufferGeometry();
      const points = NQD.decode(shape.vertices).data.slice();
      for (let i = 0; i < points.length; i++) points[i] *= s[i % 3];
      made.setAttribute("position", new THREE.BufferAttribute(points, 3));
      const faces = new Uint32Array(NQD.decode(shape.faces).data);
      made.setIndex(new THREE.BufferAttribute(faces, 1));
      made.computeVertexNormals();
      return made;
    }
    const made = shape.kind === "capsule"
      ? new THREE.CapsuleGeometry(s[0], 2 * s[1], 10, 24)
      : new THREE.CylinderGeometry(s[0], s[0], 2 * s[1], 32);
    return made.rotateX(Math.PI / 2); // three.js has the axis along y, we along z
  }

  // Writes a frame as a matrix of column vectors, moved along y.
  function writeMatrix(frame, i, shift, out, k) {
    const x = frame[i + 3], y = frame[i + 4], z = frame[i + 5], w = frame[i + 6];
    out[k] = 1 - 2 * (y * y + z * z);
    out[k + 1] = 2 * (x * y + w * z);
    out[k + 2] = 2 * (x * z - w * y);
    out[k + 3] = 0;
    out[k + 4] = 2 * (x * y - w * z);
    out[k + 5] = 1 - 2 * (x * x + z * z);
    out[k + 6] = 2 * (y * z + w * x);
    out[k + 7] = 0;
    out[k + 8] = 2 * (x * z + w * y);
    out[k + 9] = 2 * (y * z - w * x);
    out[k + 10] = 1 - 2 * (x * x + y * y);
    out[k + 11] = 0;
    out[k + 12] = frame[i];
    out[k + 13] = frame[i + 1] + shift;
    out[k + 14] = frame[i + 2];
    out[k + 15] = 1;
  }

  // Makes a view inside an element, for a number of worlds.
  NQD.View = function (container, drawing, worlds) {
    const view = this;
    view.drawing = drawing;
    view.worlds = worlds;
    view.tree = NQD.tree(drawing);
    view.frames = new Float64Array(7 * view.tree.size * worlds);
    view.shift = new Float64Array(worlds);
    view.container = container;
    view.scene = new THREE.Scene();
    view.camera = new THREE.PerspectiveCamera(
      FIELD, 1, 0.02 * drawing.radius, 400 * drawing.radius);
    view.camera.up.set(0, 0, 1);
    view.renderer = new THREE.WebGLRenderer({ antialias: true });
    view.renderer.shadowMap.enabled = true;
    view.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    const canvas = view.renderer.domElement;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", drawing.name + " in motion");
    container.appendChild(canvas);
    view.controls = new THREE.OrbitControls(view.camera, view.renderer.domElement);
    view.changed = true; // whether the next frame has to draw
    const again = () => { view.changed = true; };
    view.controls.addEventListener("change", again);
    view.renderer.domElement.addEventListener("webglcontextrestored", again);
    view.controls.maxPolarAngle = 0.497 * Math.PI; // not below the ground
    view.controls.minDistance = 0.3 * drawing.radius;
    view.controls.maxDistance = 60 * drawing.radius;
    view.lights();
    view.ground();
    view.meshes();
    view.marks();
    view.home();
    view.theme("light");
    view.resize();
  };

  const View = NQD.View.prototype;

  View.lights = function () {
    const r = this.drawing.radius;
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a898, 1.7));
    this.sun = new THREE.DirectionalLight(0xffffff, 1.9);
    this.sun.castShadow = true;
    // a small picture shows no finer shadow
    const fine = this.container.clientWidth > 400 ? 1024 : 256;
    this.sun.shadow.mapSize.set(fine, fine);
    const box = this.sun.shadow.camera;
    box.left = box.bottom = -4 * r;
    box.right = box.top = 4 * r;
    box.near = 0.1 * r;
    box.far = 24 * r;
    this.sun.shadow.bias = -0.0005;
    this.sun.shadow.normalBias = 0.02 * r;
    this.scene.add(this.sun, this.sun.target);
  };

  // The ground moves with the camera. Its material draws the grid at world positions,
  // so lines have no depth of their own and fade where they are finer than a pixel.
  View.ground = function () {
    const r = this.drawing.radius, far = 300 * r;
    this.step = this.drawing.grid;
    this.grid = {
      gridStep: { value: this.step },
      gridMinor: { value: new THREE.Color() },
      gridMajor: { value: new THREE.Color() },
    };
    const material = new THREE.MeshStandardMaterial({ roughness: 1 });
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, this.grid);
      shader.vertexShader = "varying vec2 vGrid;\n" + shader.vertexShader.replace(
        "#include <project_vertex>",
        "#include <project_vertex>\nvGrid = (modelMatrix * vec4(transformed, 1.0)).xy;");
      shader.fragmentShader = GRID + shader.fragmentShader.replace(
        "#include <color_fragment>", "#include <color_fragment>\n" + GRID_LINES);
    };
    this.plane = new THREE.Mesh(new THREE.PlaneGeometry(far, far), material);
    this.plane.receiveShadow = true;
    this.scene.add(this.plane);
  };

  View.meshes = function () {
    const drawing = this.drawing;
    this.shapes = drawing.shapes.map((shape) => {
      const color = shape.color;
      const clear = color[3] < 1;
      const material = new THREE.MeshStandardMaterial({
        roughness: 0.65, transparent: clear, opacity: color[3],
      });
      if (!shape.visual) {
        material.wireframe = true;
        material.transparent = true;
        material.opacity = 0.35;
      }
      const mesh = new THREE.InstancedMesh(geometry(shape), material, this.worlds);
      mesh.instanceMatrix.setUsage(THREE.DynamicDrawUsage);
      mesh.castShadow = mesh.receiveShadow = shape.visual;
      mesh.frustumCulled = false;
      mesh.visible = shape.visual;
      this.scene.add(mesh);
      return { mesh: mesh, body: shape.body, frame: shape.frame, shape: shape };
    });
    this.paint();
  };

  // Gives worlds their colours: the first has those of the files if it is alone.
  View.paint = function () {
    this.changed = true;
    const own = new THREE.Color(), mark = new THREE.Color();
    for (const each of this.shapes) {
      const c = each.shape.color;
      for (let w = 0; w < this.worlds; w++) {
        own.setRGB(c[0], c[1], c[2], "srgb");
        if (!each.shape.visual) own.set(NQD.palette[0]);
        else if (this.worlds > 1 && each.body >= 0) {
          own.lerp(mark.set(NQD.palette[w % NQD.palette.length]), 0.6);
        }
        each.mesh.setColorAt(w, own);
      }
      each.mesh.instanceColor.needsUpdate = true;
    }
  };

  // Trails, link origins and contact impulses.
  View.marks = function () {
    this.trails = [];
    for (let w = 0; w < this.worlds; w++) {
      const made = new THREE.BufferGeometry();
      made.setAttribute(
        "position", new THREE.BufferAttribute(new Float32Array(3 * TRAIL), 3));
      made.setDrawRange(0, 0);
      const color = NQD.palette[w % NQD.palette.length];
      const line = new THREE.Line(made, new THREE.LineBasicMaterial({ color: color }));
      line.frustumCulled = false;
      this.scene.add(line);
      this.trails.push(line);
    }
    const count = this.tree.size * this.worlds;
    const origins = new THREE.BufferGeometry();
    origins.setAttribute(
      "position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
    this.origins = new THREE.Points(origins, new THREE.PointsMaterial({
      color: 0xff00ff, size: 7, sizeAttenuation: false, depthTest: false,
      toneMapped: false, fog: false, transparent: true,
    }));
    this.origins.frustumCulled = false;
    this.origins.visible = false;
    this.origins.renderOrder = 10;
    this.scene.add(this.origins);
    // cones that are seen through the robot, as an impulse points into a foot
    const cone = new THREE.CylinderGeometry(0, 0.035 * this.drawing.radius, 1, 12);
    cone.rotateX(Math.PI / 2).translate(0, 0, 0.5);
    this.arrows = new THREE.InstancedMesh(cone, new THREE.MeshStandardMaterial({
      color: 0xd1242f, emissive: 0x8a1018, depthTest: false, transparent: true,
      opacity: 0.85, fog: false,
    }), Math.max(1, ARROWS * this.worlds));
    this.arrows.count = 0;
    this.arrows.frustumCulled = false;
    this.arrows.renderOrder = 9;
    this.arrows.visible = false;
    this.scene.add(this.arrows);
  };

  // Puts worlds on one place, or beside each other along y.
  View.arrange = function (apart, spacing) {
    this.apart = apart;
    for (let w = 0; w < this.worlds; w++) this.shift[w] = apart ? -w * spacing : 0;
    for (const each of this.shapes) {
      if (each.body < 0) each.mesh.count = apart ? this.worlds : 1;
    }
    this.scene.updateMatrixWorld(true);
    this.place();
  };

  // Shows the coordinates q[at] of a world; `place` then moves the meshes.
  View.pose = function (world, q, at) {
    const size = 7 * this.tree.size;
    NQD.kinematics(
      this.tree, q, at, this.frames.subarray(size * world, size * (world + 1)));
  };

  const placed = new Float64Array(7);

  View.place = function () {
    this.changed = true;
    const size = 7 * this.tree.size;
    for (const each of this.shapes) {
      if (!each.mesh.visible) continue;
      const out = each.mesh.instanceMatrix.array;
      for (let w = 0; w < each.mesh.count; w++) {
        if (each.body < 0) {
          writeMatrix(each.frame, 0, this.shift[w], out, 16 * w);
        } else {
          NQD.compose(this.frames, size * w + 7 * each.body, each.frame, 0, placed, 0);
          writeMatrix(placed, 0, this.shift[w], out, 16 * w);
        }
      }
      each.mesh.instanceMatrix.needsUpdate = true;
    }
    if (this.origins.visible) {
      const array = this.origins.geometry.attributes.position;
      for (let i = 0; i < this.worlds * this.tree.size; i++) {
        const w = Math.floor(i / this.tree.size);
        array.array[3 * i] = this.frames[7 * i];
        array.array[3 * i + 1] = this.frames[7 * i + 1] + this.shift[w];
        array.array[3 * i + 2] = this.frames[7 * i + 2];
      }
      array.needsUpdate = true;
    }
  };

  // Position of a world's torso, in the scene.
  View.torso = function (world, out) {
    const i = 7 * (this.tree.size * world + this.drawing.torso);
    return out.set(
      this.frames[i], this.frames[i + 1] + this.shift[world], this.frames[i + 2]);
  };

  // Draws the way of a world: `points` holds three numbers for each frame up to `last`.
  View.trail = function (world, points, last) {
    this.changed = true;
    const line = this.trails[world], array = line.geometry.attributes.position;
    const stride = Math.max(1, Math.ceil((last + 1) / TRAIL));
    let n = 0;
    for (let k = 0; k <= last && n < TRAIL; k += stride, n++) {
      array.array[3 * n] = points[3 * k];
      array.array[3 * n + 1] = points[3 * k + 1] + this.shift[world];
      array.array[3 * n + 2] = points[3 * k + 2];
    }
    array.needsUpdate = true;
    line.geometry.setDrawRange(0, n);
  };

  // Draws arrows: six numbers each, start and end.
  View.impulses = function (points) {
    this.changed = true;
    const out = this.arrows.instanceMatrix.array;
    const count = Math.min(points.length / 6, out.length / 16);
    const along = new THREE.Vector3(), first = new THREE.Vector3();
    const second = new THREE.Vector3();
    for (let i = 0; i < count; i++) {
      const p = points.slice(6 * i, 6 * i + 6);
      along.set(p[3] - p[0], p[4] - p[1], p[5] - p[2]);
      first.set(1, 0, 0);
      if (Math.abs(along.x) > 0.9 * along.length()) first.set(0, 1, 0);
      second.copy(along).cross(first).normalize();
      first.copy(second).cross(along).normalize();
      [first, second, along].forEach((axis, c) => axis.toArray(out, 16 * i + 4 * c));
      out.set(p.slice(0, 3), 16 * i + 12);
      out[16 * i + 3] = out[16 * i + 7] = out[16 * i + 11] = 0;
      out[16 * i + 15] = 1;
    }
    this.arrows.count = count;
    this.arrows.instanceMatrix.needsUpdate = true;
  };

  // Looks at the robot from the side and above, from where no wall hides it.
  View.home = function () {
    const c = this.drawing.centre, away = this.drawing.camera;
    this.controls.target.set(c[0], c[1], c[2]);
    this.camera.position.set(c[0] + away[0], c[1] + away[1], c[2] + away[2]);
    this.controls.update();
  };

  // Moves camera and target by the same vector, to a new target.
  View.lookAt = function (x, y, z) {
    const t = this.controls.target;
    this.camera.position.x += x - t.x;
    this.camera.position.y += y - t.y;
    this.camera.position.z += z - t.z;
    t.set(x, y, z);
  };

  View.theme = function (name) {
    this.changed = true;
    const t = THEMES[name];
    this.scene.background = new THREE.Color(t.sky);
    this.scene.fog = new THREE.Fog(t.sky);
    this.plane.material.color.set(t.ground);
    this.grid.gridMinor.value.set(t.minor);
    this.grid.gridMajor.value.set(t.major);
  };

  View.resize = function () {
    this.changed = true;
    const width = Math.max(1, this.container.clientWidth);
    const height = Math.max(1, this.container.clientHeight);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  };

  // Draws, if the picture has changed since it was drawn.
  View.render = function () {
    this.controls.update(); // tells of a camera that has moved
    if (!this.changed) return;
    this.changed = false;
    const t = this.controls.target, r = this.drawing.radius;
    this.plane.position.set(t.x, t.y, 0);
    const away = this.camera.position.distanceTo(t);
    this.scene.fog.near = 12 * r + 1.5 * away;
    this.scene.fog.far = 70 * r + 5 * away;
    this.sun.position.set(t.x - 3 * r, t.y - 4 * r, t.z + 8 * r);
    this.sun.target.position.copy(t);
    this.renderer.render(this.scene, this.camera);
  };

  // Pixel of a link's origin in the canvas, from the matrices that draw it.
  View.project = function (world, body) {
    const i = 7 * (this.tree.size * world + body);
    const point = new THREE.Vector3(
      this.frames[i], this.frames[i + 1] + this.shift[world], this.frames[i + 2]);
    point.project(this.camera);
    return [
      (point.x + 1) / 2 * this.container.clientWidth,
      (1 - point.y) / 2 * this.container.clientHeight,
    ];
  };
})();
