"""The kinds of controllers; `controllers` builds them."""

KINDS = {
    "none": "hold the keyframe's control (zero without a keyframe)",
    "constant": "hold `value`",
    "sine": "`offset` + sum over `frequencies` (Hz) of `amplitude` sin(2πft + its phase)",
    "random": "`offset` + Gauss-Markov noise of `std` and `time_constant` (s)",
    "lqr": "regulate to the keyframe; `state_weight`, `control_weight` (scipy's DARE)",
    "periodic": "a gait: cubic splines through `knots` over a `period` (s), ahead by `phase`",
    "csv": "columns t, then one per actuator, from `path`; held between rows",
    "user": "`function` = module:function(t, x) -> u, with x (run, nx) and u (run, nu)",
}
