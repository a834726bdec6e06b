// What the painter uses of three-mesh-bvh, on the three.js beside it; `make vendor` bundles it into
// flx/viewer/three-mesh-bvh.min.js.
export { MeshBVH } from "three-mesh-bvh/src/core/MeshBVH.js";
