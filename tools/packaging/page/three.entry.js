// What scene.js uses of three.js; build.js makes armctl/web/static/three.js of it.
export {
  Box3, BoxGeometry, BufferGeometry, CapsuleGeometry, CylinderGeometry, DirectionalLight, GridHelper, Group, HemisphereLight,
  Line, LineBasicMaterial, LineDashedMaterial, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, Object3D,
  PerspectiveCamera, Quaternion, Scene, SphereGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
