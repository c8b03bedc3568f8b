"""Film trained policies side by side as an animated GIF, without a display.

These runs give the film in README:

csac train Walker2d-v4 --algorithm sac --preset strong --first-seed 300 --steps 300000 --directory runs/film/walker
csac train HalfCheetah-v4 --algorithm sac --preset strong --first-seed 300 --steps 300000 --directory runs/film/cheetah
csac train PandaReach-v3 --algorithm sac --warmup-steps 1000 --steps 40000 --directory runs/film/arm
python examples/film.py runs/film/walker runs/film/cheetah runs/film/arm --out results/film.gif
"""

import argparse
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from imageio_ffmpeg import get_ffmpeg_exe

from csac.evaluation.play import play
from csac.record.sets import RunSet

SIZE, FRAMES_PER_SECOND = 260, 20  # SIZE: pixels of each run's square


def film(runs: Sequence[Path], out: Path, begin: float = 1.0, seconds: float = 4.0) -> None:
    """Film each run's policy from `begin` seconds on, in one GIF."""
    with tempfile.TemporaryDirectory() as folder:
        inputs: list[str] = []
        for index, run in enumerate(runs):
            video = f"{folder}/{index}.mp4"
            length = int(RunSet.open(run).evaluations["length"][-1])
            for episode in play(run, video=video, episodes=min(8, 1 + 200 // length)):
                print(f"{run}: an episode of {episode.length} steps with return {episode.episode_return:,.1f}")
            inputs += ["-ss", f"{begin}", "-t", f"{seconds}", "-i", video]
        command = [
            get_ffmpeg_exe(),
            "-y",
            "-loglevel",
            "error",
            *inputs,
            "-filter_complex",
            beside(len(runs)),
            str(out),
        ]
        subprocess.run(command, check=True)
    print(f"{out}: {out.stat().st_size / 2**20:.1f} MiB")


def beside(count: int) -> str:
    """Return the ffmpeg filter that crops videos to squares, joins them in a row and computes a palette."""
    square = f"fps={FRAMES_PER_SECOND},crop='min(iw,ih)':'min(iw,ih)',scale={SIZE}:{SIZE}:flags=lanczos"
    squares = ";".join(f"[{index}:v]{square}[square{index}]" for index in range(count))
    row = "".join(f"[square{index}]" for index in range(count)) + f"hstack=inputs={count}"
    return f"{squares};{row},split[a][b];[a]palettegen=max_colors=96[p];[b][p]paletteuse=dither=bayer:bayer_scale=4"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="two runs or more")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    film(arguments.runs, arguments.out)
