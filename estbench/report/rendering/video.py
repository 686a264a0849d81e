"""`estbench video`: truth, ghost and covariance, with a chart of NEES under the picture."""

import io
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstbenchError, MissingExtraError, StoreError
from estbench.report.rendering.chart import Chart
from estbench.report.rendering.render import Renderer
from estbench.report.rendering.replay import Replay
from estbench.shapes import Array
from estbench.tables.destination import check_file

try:
    from PIL import Image
except ImportError:
    raise MissingExtraError("pillow", "video") from None

Say = Callable[[int, int], None]

FORMATS = (".mp4", ".gif", ".png")
MOST_FRAMES = 20_000


@dataclass(frozen=True)
class Look:
    """Size and speed of a video.

    Attributes:
        width, height: size of the robot's picture, even numbers of pixels; the chart is below it.
        fps: frames per second.
        speed: seconds of the run per second of the video.
        camera: name of a camera of the model; default as in `Renderer`.
    """

    width: int = 640
    height: int = 480
    fps: float = 25.0
    speed: float = 1.0
    camera: str | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not 64 <= value <= 4096 or value % 2:
                raise EstbenchError(f"--{name} is {value}; use an even number from 64 to 4096")
        for name in ("fps", "speed"):
            if not 0 < getattr(self, name) <= 1000:
                raise EstbenchError(f"--{name} is {getattr(self, name):g}; use one in (0, 1000]")

    @property
    def strip(self) -> int:
        """Height of the chart, pixels."""
        return max(60, 2 * round(self.height / 8))


def frame_steps(times: Array, fps: float, speed: float = 1.0) -> NDArray[np.intp]:
    """Index `(frame,)` of the instant that each frame shows: the last one before or at its time.

    Raises:
        EstbenchError: more than `MOST_FRAMES` frames.
    """
    count = math.floor((times[-1] - times[0]) * fps / speed + 1e-9) + 1
    if count > MOST_FRAMES:
        raise EstbenchError(
            f"{count} frames are too many (at most {MOST_FRAMES}); lower --fps or raise --speed"
        )
    shown = times[0] + np.arange(count) * speed / fps
    return np.searchsorted(times, shown + 1e-9, side="right") - 1


def write(
    run: Replay, path: Path, look: Look, at: float | None = None, say: Say = lambda i, n: None
) -> int:
    """Write a video (`.mp4`, `.gif`) or, with `at`, one frame of it (`.png`).

    Args:
        run: the run to show.
        path: the file; its suffix gives the format.
        look: size and speed.
        at: time of a `.png`, s.
        say: called with the count of finished frames and of all frames.

    Returns:
        Count of the frames that were written.

    Raises:
        RenderError: this machine cannot draw.
        MissingExtraError: the encoder is not installed.
        EstbenchError: an unknown format, or no such time.
    """
    kind = path.suffix.lower()
    check(path, at)
    if kind == ".png":
        assert at is not None
        if not run.times[0] <= at <= run.times[-1]:
            raise EstbenchError(f"--at is {at:g} s; the run is from 0 to {run.times[-1]:g} s")
        steps = np.array([np.searchsorted(run.times, at + 1e-9, side="right") - 1])
    else:
        steps = frame_steps(run.times, look.fps, look.speed)

    def counted() -> Iterator[NDArray]:
        for i, frame in enumerate(frames(run, steps, look)):
            yield frame
            say(i + 1, len(steps))

    try:
        {".mp4": _mp4, ".gif": _gif, ".png": _png}[kind](counted(), path, look)
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())[:200]
        raise StoreError(f"{path} cannot be written: {reason}; choose --out") from None
    return len(steps)


def check(path: Path, at: float | None) -> None:
    """Refuse a file that cannot be written, before anything is simulated or drawn.

    Raises:
        EstbenchError: an unknown format, or `at` without a `.png` or the reverse.
        StoreError: the folder does not exist or cannot be written.
        MissingExtraError: the encoder is not installed.
    """
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise EstbenchError(f"--out {path}: no such format; use {', '.join(FORMATS)}")
    if (kind == ".png") != (at is not None):
        raise EstbenchError("a .png is one frame: give --at its time in s (and only then)")
    check_file(path)
    if kind == ".mp4":
        _encoder()


def clip(run: Replay, look: Look) -> tuple[bytes, bytes]:
    """A video as MP4 and its middle frame as JPEG, for the report."""
    steps = frame_steps(run.times, look.fps, look.speed)
    pictures = list(frames(run, steps, look))
    poster = io.BytesIO()
    Image.fromarray(pictures[len(pictures) // 2]).save(poster, "JPEG", quality=80)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        _mp4(iter(pictures), path, look)
        return path.read_bytes(), poster.getvalue()


def frames(run: Replay, steps: NDArray[np.intp], look: Look) -> Iterator[NDArray]:
    """The frames `(height + strip, width, 3)` of some instants."""
    chart = Chart(run, look.width, look.strip)
    with Renderer(run.model, look.width, look.height, look.camera) as renderer:
        for step in steps:
            unknown = run.log and not np.isfinite(run.truth[step]).all()
            x = None if unknown else run.truth[step]
            picture = renderer.draw(x, run.estimate[step], run.cov[step])
            yield np.concatenate([picture, chart.draw(int(step))])


def _encoder() -> None:
    """Refuse an MP4 without its encoder.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", "video") from None


def _mp4(pictures: Iterator[NDArray], path: Path, look: Look) -> None:
    import imageio_ffmpeg

    settings: dict[str, Any] = {
        "fps": look.fps, "codec": "libx264", "pix_fmt_in": "rgb24", "pix_fmt_out": "yuv420p",
        "macro_block_size": 2, "quality": None, "ffmpeg_log_level": "error",
        "output_params": ["-crf", "25", "-preset", "medium", "-movflags", "+faststart"],
    }  # fmt: skip
    size = (look.width, look.height + look.strip)
    writer = imageio_ffmpeg.write_frames(str(path), size, **settings)
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
    finally:
        writer.close()


def _gif(pictures: Iterator[NDArray], path: Path, look: Look) -> None:
    first, *rest = [Image.fromarray(p).quantize(128, dither=Image.Dither.NONE) for p in pictures]
    first.save(
        path, save_all=True, append_images=rest, duration=round(1000 / look.fps), loop=0,
        optimize=True,
    )  # fmt: skip


def _png(pictures: Iterator[NDArray], path: Path, look: Look) -> None:
    Image.fromarray(next(pictures)).save(path, optimize=True)
