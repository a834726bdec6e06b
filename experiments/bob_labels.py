"""A painted duck at 5,000 vertices, told what is where: body, spots and beak.

flx labels PATH/bob_tri.obj --colors 4 --out bob_labels.png
flx train experiments/bob_labels.py --surface.path PATH/bob_tri.obj --surface.labels bob_labels.png
flx sample runs/bob_labels
flx sample runs/bob_labels --labels other.png --guidance 2

The first line proposes labels from the colours of the texture; correct them, or paint your own, in any
painting program. The last one paints by another image of the same colours: what it shows goes where it shows
it. `--guidance 0` ignores labels.

Training takes as long as that of the demo, about 10 minutes on two CPU cores. Expect spots and beak where the
labels say (docs/results.md has the pictures).
"""

from dataclasses import replace

from flx.config import quick

demo = quick("bob_tri.obj", name="bob_labels")
# Of the draws, a fifth sees no labels: guidance compares what the network says without them, too.
config = replace(
    demo,
    model=replace(demo.model, label_dropout=0.2),
    surface=replace(demo.surface, labels="bob_labels.png"),
)
