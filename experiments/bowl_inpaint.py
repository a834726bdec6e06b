"""A scanned bowl at 5,000 vertices, to make parts of it new and keep the rest to the bit.

flx train experiments/bowl_inpaint.py --surface.path PATH/akita_black_bowl.obj
flx sample runs/bowl_inpaint --fill MASK.png

A mask is an image as large as the texture, here 4096², and white where it should become new. The training
knows nothing of it: inpainting is an option of sampling. Where the texture itself is damaged, train with
`--surface.fill MASK.png` as well, so that the damage is not learnt.

Training is as long as that of the demo, 11 minutes on two busy CPU cores. A sample takes twice the steps of
a plain one. Expect a border that cannot be seen (`border_ratios` in samples.json, 1.19 to 1.24 here) and,
inside, strokes that are torn: 5,000 vertices are few for this pattern. The run of experiments/bowl.py, with
10,000, does better, above all with `--height z` (docs/gallery.md).
"""

from dataclasses import replace

from flx.config import quick

demo = quick("akita_black_bowl.obj", name="bowl_inpaint")
config = replace(demo, surface=replace(demo.surface, up="z"))
