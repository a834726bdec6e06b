"""The texture of a boulder (Poly Haven, boulder_01), to be painted on other meshes.

flx train experiments/boulder_transfer.py --surface.path PATH/boulder_01_1k.gltf
flx sample runs/boulder_transfer --mesh OTHER.glb

Transfer itself is `flx sample --mesh` on any run, this one or another: the other mesh needs no texture, and
is triangulated so that details keep their size, in the units of the two files. Without training it is
flx sample PATH/boulder_01_1k.gltf --instant --mesh OTHER.glb. The settings are the demo's with fewer
vertices: 6 minutes of training on two busy cores. Expect grain and cracks of their size on any shape
(docs/gallery.md).
"""

from dataclasses import replace

from flx.config import Surface, quick

demo = quick(name="boulder_transfer")
config = replace(
    demo,
    surface=Surface(path="boulder_01_1k.gltf", vertices=3000, copies=8),
)
