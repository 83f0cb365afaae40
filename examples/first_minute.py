# %% [markdown]
# # The first minute
#
# This page trains the demo scene twice, shows and compares what came out, and exports it. It needs
# the extra `export`, but neither network nor GPU. `first_minute.ipynb` and `first_minute.py` have
# the same cells. Before you run them again, delete `outputs/first_minute`.

# %%
import json
import os
import shlex
import sys
from pathlib import Path

import torch

from xplanes import RadianceModule
from xplanes.cli import main

# Short runs, so that all cells take two to three minutes on two CPU cores. The environment
# variable replaces these settings; the tests train for fewer steps on smaller images.
SETTINGS = shlex.split(os.environ.get("FIRST_MINUTE_SETTINGS", "trainer.max_seconds=20"))
OUTPUTS = Path("outputs", "first_minute")


def xplanes(*arguments):
    """Do what the command line does: `xplanes train lrm=none`, `xplanes render RUN`, ..."""
    if main([str(argument) for argument in arguments]) != 0:
        raise RuntimeError("the command failed; its message stands above")


def show(picture):
    """Show a picture below a cell; a script prints where it is."""
    print(picture)
    if "ipykernel" in sys.modules:
        from IPython.display import Image, display

        display(Image(filename=picture))


# %% [markdown]
# ## Train
#
# The first run renders the scene and reads the bundled LRM. The LRM turns the frames of a fixed
# camera into triplanes; robust PCA and a conversion make feature planes of them, with which
# training begins.

# %%
first = OUTPUTS / "lrm"
xplanes("train", *SETTINGS, f"hydra.run.dir={first}")

# %% [markdown]
# ## Look
#
# A run directory holds the scores, the pictures and the checkpoints. `decomposition.png` shows the
# static and the moving part of the triplanes.

# %%
show(first / "media" / "decomposition.png")
print(json.loads((first / "metrics.json").read_text())["test"])

# %% [markdown]
# ## Change a setting
#
# Settings are `key=value` pairs: here the same run with random initialisation. All of them are in
# the documentation, under "Configuration".

# %%
second = OUTPUTS / "random"
xplanes("train", *SETTINGS, "lrm=none", f"hydra.run.dir={second}")
xplanes("table", OUTPUTS)

# %% [markdown]
# ## Render
#
# One picture at one time, from a camera of your choice. `orbit.webp` instead of the PNG would be a
# video: the camera goes round, and time goes back and forth.

# %%
picture = OUTPUTS / "picture.png"
xplanes("render", first, "--path", "fixed", "--time", "0.5", "--size", "320", "--out", picture)
show(picture)

# %% [markdown]
# ## Use it in Python
#
# A checkpoint is enough to build the field again: points and times to colour and density.

# %%
module = RadianceModule.load_from_checkpoint(first / "checkpoints" / "last.ckpt")
points, times = 2 * torch.rand(5, 3) - 1, torch.rand(5)
with torch.no_grad():
    colour, density = module.field(points, times)
print(colour, density)

# %% [markdown]
# ## Export
#
# One HTML file that plays the meshes of eight timesteps: open it in a browser, or send it to
# somebody. `--what mesh` writes files for other programs.

# %%
xplanes("export", first, "--what", "web", "--times", "8", "--out", OUTPUTS / "web")
print("open", OUTPUTS / "web" / "index.html")
