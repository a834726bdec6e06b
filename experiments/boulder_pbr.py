"""The boulder of Poly Haven with all maps of its material: relief and roughness follow the new colours.

flx train experiments/boulder_pbr.py --surface.path PATH/boulder_01_1k.gltf
flx sample runs/boulder_pbr

The images that the glTF names must lie beside it: colours, normals (nor_gl) and roughness (arm). The network
learns base colours alone; a sample begins with pieces of the input, and the other maps come from the same
pieces, normals turned with them. So no `--invention 1` and no `--strength` here: the other maps would stay as
they are, as a line says. Without training: flx sample PATH/boulder_01_1k.gltf --instant.

Training takes what boulder_transfer.py takes. How well the maps fit has not been measured on this mesh;
docs/results.md says it of a vase whose maps come from one height.
"""

from dataclasses import replace

from flx.config import Surface, quick

demo = quick(name="boulder_pbr")
config = replace(
    demo,
    surface=Surface(path="boulder_01_1k.gltf", vertices=3000, copies=8),
)
