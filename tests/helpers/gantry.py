"""A gantry with a hand, as MJCF: four joints, two fingers."""

FINGER = (
    '<body name="{0}" pos="0 0 -0.06">'
    '<joint name="{0}" type="slide" axis="0 {1} 0" range="0 0.04" armature="0.05" damping="1"/>'
    '<geom name="{0}_pad" type="box" size="0.01 0.004 0.025" pos="0 {2} -0.025" mass="0.02" friction="1.5" solref="0.004 1"/>'
    "</body>"
)
# A hand that hangs in a gantry: it slides along x, y and z, and turns about the vertical. It can hold from above only.
GANTRY = f"""<mujoco><worldbody><body name="bridge" pos="0 0 0.6">
<joint name="x" type="slide" axis="1 0 0" range="-0.4 0.4"/><geom type="box" size="0.02 0.02 0.02" mass="1"/>
<body name="trolley"><joint name="y" type="slide" axis="0 1 0" range="-0.4 0.4"/>
<geom type="box" size="0.02 0.02 0.02" mass="1"/>
<body name="column"><joint name="z" type="slide" axis="0 0 1" range="-0.45 0"/>
<geom type="cylinder" size="0.015 0.02" pos="0 0 -0.04" mass="1"/>
<body name="hand" pos="0 0 -0.07"><joint name="turn" axis="0 0 -1" range="-3 3" armature="0.01"/>
<geom name="palm" type="box" size="0.02 0.06 0.01" pos="0 0 -0.045" mass="0.3"/>
<site name="grasp" pos="0 0 -0.1" euler="3.14159265 0 0"/>
{FINGER.format("left", 1, 0.004)}{FINGER.format("right", -1, -0.004)}</body></body></body></body></worldbody>
<compiler angle="radian"/><equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0" solref="0.005 1"/></equality>
<tendon><fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>
<actuator><motor joint="x" ctrlrange="-200 200"/><motor joint="y" ctrlrange="-200 200"/><motor joint="z" ctrlrange="-200 200"/>
<motor joint="turn" ctrlrange="-20 20"/>
<position name="grip" tendon="split" kp="400" kv="40" ctrlrange="0 0.04" forcerange="-60 60"/></actuator></mujoco>"""
