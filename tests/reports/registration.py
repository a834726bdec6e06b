"""Do the maps of a material stay in register? A vase whose colours, normals and roughness are of one height.

python tests/reports/registration.py make bumps.glb
flx train bumps.glb --train.steps 400 --surface.vertices 2500 --surface.copies 4
flx sample runs/bumps --count 2 --texture-size 1024
flx sample bumps.glb --instant --count 2 --texture-size 1024 --vertices 2500
python tests/reports/registration.py measure bumps.glb FOLDER/variation_00.glb FOLDER/variation_01.glb

The last line prints, of each file, the correlation of the gradient of its luminance with how far its normals
lean, as vectors on the surface, and that of luminance and smoothness: 1 is in register. The row "maps of the
input" has the colours of the last file and the other maps of the first: what is left where maps do not
follow.
"""

import argparse
import sys
from pathlib import Path

import flx
from flx.assets.read import read_with_maps

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.bumps import bumpy, registration, write_bumpy

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["make", "measure"])
    parser.add_argument("paths", type=Path, nargs="+")
    options = parser.parse_args()
    if options.what == "make":
        write_bumpy(bumpy(flx.vase(), 1024, 500), options.paths[0])
    else:
        meshes = {str(path): read_with_maps(path).mesh for path in options.paths}
        first, last = (meshes[str(options.paths[n])] for n in (0, -1))
        if last is not first:
            maps = {**first.maps, "base_color": last.maps["base_color"]}
            meshes["maps of the input"] = last._replace(maps=maps)
        print("| file | colour and normal | colour and roughness |\n|---|---|---|")
        for name, mesh in meshes.items():
            found = registration(mesh)
            print(f"| {name} | {found['normal']:.3f} | {found['roughness']:.3f} |")
