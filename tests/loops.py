"""Robots with equality constraints of each type."""

_HEAD = """<mujoco><option timestep="0.002"/><default>
<equality solref=".005 1" solimp=".95 .99 .001"/>
<geom contype="0" conaffinity="0" type="capsule" size=".005" mass=".01"/>
<joint axis="0 1 0" damping=".001"/></default>"""

FOUR_BAR = f"""{_HEAD}<worldbody>
<body><joint name="crank" armature=".005" damping=".1"/><geom fromto="0 0 0 0 0 .03"/>
 <body pos="0 0 .03"><joint name="coupler"/><geom fromto="0 0 0 .06 0 .02"/>
  <body name="rocker" pos=".06 0 .02"><joint name="rocker"/><geom fromto="0 0 0 0 0 -.05"/></body>
 </body></body></worldbody>
<equality><connect body1="rocker" anchor="0 0 -.05"/></equality></mujoco>"""

COUPLED = f"""{_HEAD}<worldbody>
<body><joint name="lift" armature=".01"/><geom fromto="0 0 0 .1 0 0"/>
 <body pos=".1 .02 0"><joint name="left" axis="0 0 1"/><geom fromto="0 0 0 .05 0 0"/></body>
 <body pos=".1 -.02 0"><joint name="right" axis="0 0 1"/><geom fromto="0 0 0 .05 0 0"/></body>
</body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality></mujoco>"""

WELD = f"""{_HEAD}<worldbody>
<body name="arm"><joint name="arm" armature=".01"/><geom fromto="0 0 0 .1 0 0"/></body>
<body name="tool" pos=".1 0 0"><freejoint name="tool"/><geom fromto="0 0 0 .05 0 .01"/></body>
</worldbody><equality><weld body1="arm" body2="tool"/></equality></mujoco>"""

TENDON = f"""{_HEAD}<worldbody>
<body><joint name="near"/><geom fromto="0 0 0 0 0 -.1"/>
 <body pos="0 0 -.1"><joint name="far"/><geom fromto="0 0 0 0 0 -.1"/></body></body></worldbody>
<tendon><fixed name="belt">
<joint joint="near" coef="1"/><joint joint="far" coef="2"/></fixed></tendon>
<equality><tendon tendon1="belt"/></equality></mujoco>"""

LOOPS = {"four_bar": FOUR_BAR, "coupled": COUPLED, "weld": WELD, "tendon": TENDON}
