r"""The README's table of scores, from runs that are there: records them with the machine, then prints the table.

    crossray quickstart
    jobs/train_scene_cpu.yaml --set scene.path=reichstag --set name=reichstag-R8
    jobs/train_scene_cpu.yaml --set scene.path=reichstag --set name=reichstag-R8-nerf --set method=nerf \
        --set model.field=hash --set "evaluate.protocols=[crnerf-full@R8,nerfw-half@R8,crnerf-full@R8+affine,\
nerfw-half@R8+affine]"
    python benchmarks/scores.py --quickstart quickstart --crossray runs/reichstag-R8 --nerf runs/reichstag-R8-nerf \
        --out benchmarks/results/scores.json

The two runs are of one scene with the same field, ranks and seconds; both were evaluated under crnerf-full@R8 and
nerfw-half@R8, and the NeRF run under both with +affine as well.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from pipeline.files import atomic_write
from pipeline.provenance import provenance

PROTOCOLS = ("crnerf-full@R8", "nerfw-half@R8")


def scores_of(run: Path) -> dict:
    """Training record and every evaluation of a run's newest evaluated checkpoint."""
    evaluations = {}
    for folder in sorted((run / "eval").iterdir()):
        metrics = json.loads(sorted(folder.glob("step-*/metrics.json"))[-1].read_text())
        images = {row["name"]: {k: row[k] for k in ("psnr", "ssim", "lpips") if k in row} for row in metrics["images"]}
        evaluations[folder.name] = {"mean": metrics["mean"], "images": images, "versions": metrics["versions"]}
    return {"training": json.loads((run / "training.json").read_text()), "evaluations": evaluations}


def table(quick: dict, ours: dict, nerf: dict) -> list[str]:
    """Rows of the README's table."""
    seconds = round(quick["train_seconds"])
    rows = [
        f"| landmark, quick start, {seconds} s on {quick['ranks']} cores | PSNR against the clean truth | "
        f"**{quick['psnr']:.1f}** | {quick['psnr_nerf']:.1f} | mean colour: {quick['psnr_floor']:.1f} |",
        f"| | the same, light read from another view | **{quick['psnr_cross']:.1f}** | | |",
        f"| | masks, intersection over union | **{quick['mask_iou']:.2f}** | | |",
    ]
    training = ours["training"]
    for i, protocol in enumerate(PROTOCOLS):
        a, b = (run["evaluations"][protocol] for run in (ours, nerf))
        control = nerf["evaluations"][f"{protocol}+affine"]["mean"]["psnr"]
        better = sum(row["psnr"] > b["images"][name]["psnr"] for name, row in a["images"].items())
        scene = f"Reichstag, 74 photos at R/8, {round(training['train_seconds'])} s on {training['ranks']} cores"
        rows.append(
            f"| {'' if i else scene} | PSNR, `{protocol}` (better on {better} of {len(a['images'])} photos) | "
            f"**{a['mean']['psnr']:.2f}** | {b['mean']['psnr']:.2f} | NeRF + affine fit: {control:.2f} |"
        )
        rows += [
            f"| | {name.upper()}, `{protocol}` | **{a['mean'][name]:.3f}** | {b['mean'][name]:.3f} | |"
            for name in ("ssim", "lpips")
            if name in a["mean"] and name in b["mean"]
        ]
    return rows


def main() -> None:
    """Record and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("quickstart", "crossray", "nerf", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    options = parser.parse_args()
    quick = json.loads((options.quickstart / "summary.json").read_text())
    ours, nerf = scores_of(options.crossray), scores_of(options.nerf)
    record = {"provenance": provenance(), "quickstart": quick, "reichstag": {"crossray": ours, "nerf": nerf}}
    atomic_write(options.out, json.dumps(record, indent=1) + "\n")
    print("\n".join(table(quick, ours, nerf)))
    gains = [
        row["psnr"] - nerf["evaluations"][PROTOCOLS[0]]["images"][name]["psnr"]
        for name, row in ours["evaluations"][PROTOCOLS[0]]["images"].items()
    ]
    print(f"gain over NeRF a photo: {np.min(gains):.2f} to {np.max(gains):.2f} dB")


if __name__ == "__main__":
    main()
