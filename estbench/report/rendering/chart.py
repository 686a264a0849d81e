"""The chart of NEES under a picture, up to an instant: the band, and phases of contact."""

import math

import numpy as np
from numpy.typing import NDArray

from estbench.errors import MissingExtraError
from estbench.report.rendering.replay import Replay
from estbench.shapes import Array

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError:
    raise MissingExtraError("pillow", "video") from None

_INK, _SOFT, _LINE, _BAND = (27, 31, 36), (87, 96, 106), (0, 114, 178), (228, 228, 228)
_CURSOR, _PAPER, _FUTURE = (213, 94, 0), (255, 255, 255), (160, 190, 210)
_EVENTS = {"touch-down": (0, 120, 80), "lift-off": (150, 90, 170), "slip": (230, 159, 0),
           "limit": _INK}  # fmt: skip
_FINE = 2  # the chart is drawn larger by this factor and then reduced, for smooth lines


class Chart:
    """NEES/n of a run over time with the band of a single run, and a cursor.

    Args:
        run: the run to show.
        width, height: size of the chart, pixels.
    """

    def __init__(self, run: Replay, width: int, height: int):
        self.run, self._size = run, (width, height)
        f = _FINE
        text = max(10, round(height / 8))
        self._font = _font(text * f)
        self.left, self.right = round(4.2 * text), width - round(1.2 * text)
        self.top, self.bottom = round(1.7 * text), height - round(1.8 * text)
        finite = run.nees[np.isfinite(run.nees) & (run.nees > 0)]
        low = min(0.5 * run.band[0], float(np.percentile(finite, 1)) if len(finite) else 1.0)
        high = max(2 * run.band[1], 1.2 * float(finite.max()) if len(finite) else 1.0)
        self._log = math.log10(max(low, high * 1e-6)), math.log10(high)
        x, y = self.x(run.times) * f, self.y(run.nees) * f
        self._points = [(a, b) for a, b in zip(x, y)]
        self._valid = np.isfinite(run.nees)
        self._base = Image.new("RGB", (width * f, height * f), _PAPER)
        self._axes(ImageDraw.Draw(self._base))

    def x(self, time: Array | float) -> Array:
        """Pixel column of a time."""
        first, last = self.run.times[0], self.run.times[-1]
        return self.left + (np.asarray(time) - first) / (last - first) * (self.right - self.left)

    def y(self, nees: Array | float) -> Array:
        """Pixel row of NEES/n, on a logarithmic axis; values outside are clipped to its ends."""
        low, high = self._log
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.clip((np.log10(nees) - low) / (high - low), 0.0, 1.0)
        return self.bottom - share * (self.bottom - self.top)

    def draw(self, step: int) -> NDArray:
        """The chart `(height, width, 3)` up to an instant."""
        f = _FINE
        image = self._base.copy()
        pen = ImageDraw.Draw(image)
        self._curve(pen, step + 1, _LINE)
        column = float(self.x(self.run.times[step])) * f
        pen.line([(column, self.top * f), (column, self.bottom * f)], fill=_CURSOR, width=f)
        text = _moment(self.run.times[step], self.run.nees[step], self.run.what)
        pen.text((self.right * f, 1.5 * f), text, fill=_INK, font=self._font, anchor="rt")
        return np.asarray(image.resize(self._size, Image.Resampling.BOX))

    def _curve(self, pen: "ImageDraw.ImageDraw", stop: int, colour: tuple[int, int, int]) -> None:
        """Draw NEES/n of the first `stop` instants."""
        points = [p for p, good in zip(self._points[:stop], self._valid) if good]
        if len(points) > 1:
            pen.line(points, fill=colour, width=round(1.2 * _FINE), joint="curve")

    def _contact(self, pen: "ImageDraw.ImageDraw") -> None:
        """Draw stance as a bar on the time axis, and each event as a line above it."""
        f, run = _FINE, self.run
        high = (0.75 * self.bottom + 0.25 * self.top) * f
        if run.touching is None:
            return
        columns = self.x(run.times) * f
        for left, right, stance in zip(columns[:-1], columns[1:], run.touching[:-1]):
            if stance:
                pen.rectangle([left, (self.bottom - 3) * f, right, self.bottom * f], fill=_SOFT)
        for kind, times in run.events.items():
            for column in (self.x(times) * f).tolist():
                ends = [(column, high), (column, (self.bottom - 3) * f)]
                pen.line(ends, fill=_EVENTS[kind], width=f)

    def _title(self) -> str:
        """The longest title that leaves room for the time and NEES of a frame."""
        run = self.run
        short = f"{run.label}, run {run.run}"
        room = (self.right - self.left) * _FINE - self._font.getlength(
            _moment(-999.99, 1.23e-10, run.what)
        )
        titles = (f"{run.name}: {short} (grey: {run.level:.0%})", f"{run.name}: {short}", short)
        return next((t for t in titles if self._font.getlength(t) < room), "")

    def _axes(self, pen: "ImageDraw.ImageDraw") -> None:
        """Draw what all frames share: band, pale curve, title, ticks and axes."""
        f, run = _FINE, self.run
        band = [float(self.y(v)) * f for v in run.band]
        pen.rectangle([self.left * f, band[1], self.right * f, band[0]], fill=_BAND)
        self._curve(pen, len(run.times), _FUTURE)
        pen.text((self.left * f, 1.5 * f), self._title(), fill=_INK, font=self._font, anchor="lt")
        low, high = math.ceil(self._log[0]), math.floor(self._log[1])
        decade = (self.bottom - self.top) / (self._log[1] - self._log[0])
        apart = max(1, math.ceil(1.2 * max(10, round(self._size[1] / 8)) / decade))
        for power in range(low - low % -apart, high + 1, apart):
            row = float(self.y(10.0**power)) * f
            pen.line([(self.left * f, row), (self.right * f, row)], fill=_SOFT, width=1)
            pen.text(
                ((self.left - 4) * f, row), f"{10.0**power:g}", fill=_SOFT, font=self._font,
                anchor="rm",
            )  # fmt: skip
        self._contact(pen)
        span = run.times[-1] - run.times[0]
        tick = next(
            s * 10.0**p for p in range(-4, 6) for s in (1, 2, 5) if span / (s * 10.0**p) <= 6
        )
        for k in range(math.ceil(run.times[0] / tick), math.floor(run.times[-1] / tick + 1e-9) + 1):
            column = float(self.x(k * tick)) * f
            pen.line([(column, self.bottom * f), (column, (self.bottom + 3) * f)], fill=_SOFT,
                     width=f)  # fmt: skip
            last = k * tick > run.times[-1] - 0.05 * span
            pen.text(
                (column, (self.bottom + 4) * f), f"{k * tick:g} s", fill=_SOFT, font=self._font,
                anchor="rt" if last else "mt",
            )  # fmt: skip
        pen.line(
            [(self.left * f, self.bottom * f), (self.right * f, self.bottom * f)], fill=_SOFT,
            width=f,
        )  # fmt: skip


def _moment(time: float, nees: float, what: str) -> str:
    """Time in s and NEES/n, or NIS/m, of a frame as text."""
    return (
        f"t = {time:.2f} s   {what} = {nees:.3g}"
        if np.isfinite(nees)
        else f"t = {time:.2f} s   failed"
    )


def _font(size: int) -> "ImageFont.FreeTypeFont | ImageFont.ImageFont":
    return ImageFont.load_default(size)
