"""The types of MuJoCo's sensors and their units; MuJoCo itself is not imported for them."""

UNITS = {
    "accelerometer": "m/s²", "actuatorfrc": "N", "actuatorpos": "", "actuatorvel": "",
    "ballangvel": "rad/s", "ballquat": "rad", "camprojection": "pixel", "clock": "s",
    "contact": "", "e_kinetic": "J", "e_potential": "J", "force": "N", "frameangacc": "rad/s²",
    "frameangvel": "rad/s", "framelinacc": "m/s²", "framelinvel": "m/s", "framepos": "m",
    "framequat": "rad", "framexaxis": "", "frameyaxis": "", "framezaxis": "", "geomdist": "m",
    "geomfromto": "m", "geomnormal": "", "gyro": "rad/s", "insidesite": "", "jointactfrc": "",
    "jointlimitfrc": "", "jointlimitpos": "", "jointlimitvel": "", "jointpos": "", "jointvel": "",
    "magnetometer": "T", "plugin": "", "rangefinder": "m", "subtreeangmom": "kg m²/s",
    "subtreecom": "m", "subtreelinvel": "m/s", "tactile": "", "tendonactfrc": "N",
    "tendonlimitfrc": "N", "tendonlimitpos": "m", "tendonlimitvel": "m/s", "tendonpos": "m",
    "tendonvel": "m/s", "torque": "N m", "touch": "N", "user": "", "velocimeter": "m/s",
}  # fmt: skip
"""Unit by type; empty for the dimensionless ones, those of `JOINT_UNITS` and those of the user."""

JOINT_UNITS = {
    "jointpos": ("m", "rad"), "jointvel": ("m/s", "rad/s"), "jointactfrc": ("N", "N m"),
    "jointlimitpos": ("m", "rad"), "jointlimitvel": ("m/s", "rad/s"),
    "jointlimitfrc": ("N", "N m"),
}  # fmt: skip
"""Units at a slide and at a hinge."""
