"""A scanned bowl at 5,000 vertices, to make parts of it new and keep the rest to the bit.

flx train experiments/bowl_inpaint.py --surface.path PATH/akita_black_bowl.obj
flx sample runs/bowl_inpaint --fill MASK.png

A mask is an image as large as the texture, here 4096², and white where it should become new. The training
knows nothing of it: inpainting is an option of sampling. Where the texture itself is damaged, train with
`--surface.fill MASK.png` as well, so that the damage is not learnt.

Training is as long as that of the demo, about 8 minutes on two CPU cores. A sample takes twice the steps of
a plain one. Expect no visible border: `border_ratios` in samples.json near 1, as on the demo's vase. On the
bowl neither has been measured.
"""

from dataclasses import replace

from flx.config import quick

demo = quick("akita_black_bowl.obj", name="bowl_inpaint")
config = replace(demo, surface=replace(demo.surface, up="z"))
