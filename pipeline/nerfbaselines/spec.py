"""What nerfbaselines reads to know the method `crossray`: by the entry point of the installed package, or by
NERFBASELINES_REGISTER=<this file>.

It is read whenever nerfbaselines starts, so it imports neither torch nor the method.
"""

from __future__ import annotations

from typing import Any

from nerfbaselines import register

from pipeline.nerfbaselines import CAMERAS, FEATURES, METHOD, OUTPUTS
from pipeline.published import published_tables

PAPER = "comparison-R2"  # the paper's main table; the rows of nerfbaselines are at full size, under another protocol
NOTE = (
    "CR-NeRF's own row of its paper, for the method crnerf and not for the fast field: photos at half size, the "
    "appearance is read from the whole test photo, SSIM with a 3 x 3 window. Not comparable with scores of `nerfw`"
)


def paper_results() -> dict[str, dict[str, Any]]:
    """The paper's scores by nerfbaselines' names of the scenes, each with the protocol that it was measured under."""
    scenes = published_tables()[PAPER]["crnerf"]
    return {f"phototourism/{scene.replace('_', '-')}": {**scores, "note": NOTE} for scene, scores in scenes.items()}


register(
    {
        "id": METHOD,
        "method_class": "pipeline.nerfbaselines.method:Crossray",
        "metadata": {
            "name": "Crossray",
            "description": "CR-NeRF, whose appearance transform looks across all rays of a view, on a hash grid; "
            "with the preset `paper` on the networks of the paper.",
            "paper_title": "Cross-Ray Neural Radiance Fields for Novel-view Synthesis from Unconstrained Image "
            "Collections",
            "paper_authors": ["Yifan Yang", "Shuhai Zhang", "Zixiong Huang", "Yubing Zhang", "Mingkui Tan"],
            "paper_link": "https://arxiv.org/abs/2307.08093",
            "paper_results": paper_results(),
            "licenses": [{"name": "Apache-2.0"}],
        },
        "presets": {
            "paper": {
                "@description": "the paper's networks, half-size photos and schedule",
                "method": "crnerf",
                "scene.downscale": 2,
                "train.steps_per_epoch": 17200,
            },
        },
        "required_features": list(FEATURES),
        "supported_camera_models": list(CAMERAS),
        "supported_outputs": list(OUTPUTS),
    }
)
