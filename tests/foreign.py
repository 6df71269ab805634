"""Small models in the manner of public robots, none of them ours: what the transform must cope
with."""

QUADRUPED = """
<mujoco model="quadruped">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="0.0005" integrator="RK4"/>
  <default>
    <joint damping="0.3" armature="0.02" frictionloss="0.1" stiffness="1.5" springref="20"/>
    <tendon stiffness="50" damping="3" frictionloss="0.4" armature="0.1" springlength="0.2" range="-0.01 0.01"/>
    <position kp="120" kv="4" forcerange="-40 40"/>
    <geom type="capsule" density="700" size="0.02"/>
    <default class="leg">
      <joint axis="0 1 0" damping="1"/>
      <position inheritrange="1"/>
      <default class="hip"><joint range="-60 80"/></default>
      <default class="knee"><joint range="-150 -20" ref="-90" armature="0.05"/></default>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.6">
      <freejoint/>
      <geom type="box" size="0.2 0.1 0.05"/>
      <site name="imu"/>
      <body name="front_thigh" pos="0.2 0 0" childclass="leg">
        <joint name="front_hip" class="hip"/>
        <geom fromto="0 0 0 0 0 -0.2"/>
        <body name="front_shank" pos="0 0 -0.2">
          <joint name="front_knee" class="knee"/>
          <geom fromto="0 0 0 0.15 0 -0.1"/>
          <body pos="0.15 0 -0.1"><joint axis="0 1 0" range="-10 10"/><geom type="sphere" size="0.03"/></body>
        </body>
      </body>
      <body name="rear_thigh" pos="-0.2 0 0" childclass="leg">
        <joint name="rear_hip" class="hip" pos="0 0 0.01"/>
        <geom fromto="0 0 0 0 0 -0.2"/>
        <body name="rear_shank" pos="0 0 -0.2">
          <joint name="rear_knee" class="knee"/>
          <geom fromto="0 0 0 0.15 0 -0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position class="hip" name="front_hip" joint="front_hip"/>
    <position class="knee" name="front_knee" joint="front_knee"/>
    <position class="hip" joint="rear_hip"/>
    <position class="knee" name="rear_knee" joint="rear_knee" timeconst="0.02"/>
  </actuator>
  <sensor>
    <jointpos name="front_hip_angle" joint="front_hip"/>
    <jointvel name="rear_knee_rate" joint="rear_knee"/>
    <actuatorfrc name="front_knee_force" actuator="front_knee"/>
    <gyro name="gyro" site="imu"/>
    <framepos objtype="body" objname="trunk"/>
  </sensor>
  <keyframe>
    <key name="home" qpos="0 0 0.45 1 0 0 0  0.5 -1.4 0.02 0.4 -1.3" ctrl="0.5 -1.4 0.4 -1.3" act="-1.2"/>
    <key time="2" qpos="0 0 0.7 0 1 0 0  0.1 -1.2 0 0.2 -1.5" qvel="1 2 3 4 5 6  7 8 9 10 11"/>
  </keyframe>
</mujoco>"""
"""Free base, nested default classes with everything that could leak, inherited ranges, an
unnamed hinge, ref."""

ARM = """
<mujoco model="arm">
  <compiler angle="radian" eulerseq="XYZ" boundmass="0.001" boundinertia="1e-5"/>
  <option timestep="0.0005" integrator="RK4" gravity="0.3 -0.2 -9.7"/>
  <default>
    <motor ctrllimited="true" ctrlrange="-1 1" gear="3" damping="0.02" armature="0.001"/>
  </default>
  <worldbody>
    <body name="target" mocap="true" pos="1 0 0"><geom size="0.02" contype="0" conaffinity="0"/></body>
    <frame pos="0 0 1" euler="0.1 0 0.4">
      <body name="upper_arm">
        <inertial pos="0.15 0.01 0" mass="3" diaginertia="0.02 0.06 0.06" euler="0.2 0.1 0"/>
        <joint name="yaw" axis="0 0 1" range="-2 2" actuatorfrcrange="-60 60"/>
        <joint name="pitch" axis="0 1 0" pos="0.02 0 0.03" ref="0.3" range="-1.5 1.8" stiffness="4" springref="0.1"/>
        <joint name="roll" axis="1 0.2 0" damping="2"/>
        <frame pos="0.3 0 0" quat="0.9 0.1 0.3 -0.2">
          <frame pos="0 0 0.02">
            <body name="forearm">
              <inertial pos="0.1 0 0.02" mass="1.5" fullinertia="0.01 0.02 0.02 0.001 0.002 -0.001"/>
              <joint name="elbow" axis="0 1 0" ref="-0.7" range="-2.5 0.5" frictionloss="0.5" armature="0.3"/>
              <site name="wrist" pos="0.2 0 0"/>
              <body name="left_finger" pos="0.2 0.03 0"><geom size="0.02 0.02" type="box" fromto="0 0 0 0.06 0 0"/>
                <joint name="left_finger" axis="0 0 1" pos="0 0 0.01"/></body>
              <body name="right_finger" pos="0.2 -0.03 0"><geom size="0.02" type="capsule" fromto="0 0 0 0.06 0 0"/>
                <joint name="right_finger" axis="0 0 1"/></body>
            </body>
          </frame>
        </frame>
      </body>
    </frame>
  </worldbody>
  <contact><exclude body1="left_finger" body2="right_finger"/><exclude body1="forearm" body2="left_finger"/></contact>
  <equality><joint name="mimic" joint1="right_finger" joint2="left_finger" polycoef="0.1 -0.8 0.05 0 0"
    solref="0.002 1"/></equality>
  <actuator>
    <motor name="yaw_motor_drive" joint="yaw"/>
    <velocity name="pitch" joint="pitch" kv="40" ctrlrange="-2 2"/>
    <general name="roll" jointinparent="roll" dyntype="filter" dynprm="0.05" gainprm="20" biasprm="0 -20 -1"
      biastype="affine" actlimited="true" actrange="-2 2"/>
    <intvelocity name="elbow" joint="elbow" kp="200" kv="6" actrange="-2.5 0.5"/>
    <position name="grip" joint="left_finger" kp="8" kv="0.4"/>
  </actuator>
  <sensor><jointpos joint="elbow"/><force name="wrist_force" site="wrist"/><actuatorpos name="roll_in" actuator="roll"/>
    <tendonpos name="sum" tendon="sum"/></sensor>
  <tendon><fixed name="sum"><joint joint="yaw" coef="1"/><joint joint="pitch" coef="2"/></fixed></tendon>
  <keyframe>
    <key name="rest" qpos="0.1 0.4 -0.2 -0.5 0.2 -0.06" ctrl="0.5 0.1 0.2 -0.3 0.2" act="-0.4 -0.5"
      mpos="1 2 3" mquat="0 1 0 0"/>
  </keyframe>
</mujoco>"""
"""Fixed base in frames, three hinges on one body, activations, mimic equality, bounded masses,
mocap."""

ROVER = """
<mujoco model="rover">
  <compiler angle="degree"/>
  <option timestep="0.0005" integrator="RK4" density="1.2" viscosity="0.00002" wind="1 0 0"/>
  <default>
    <velocity kv="2" ctrllimited="true" ctrlrange="-20 20"/>
    <joint damping="0.02"/>
    <default class="wheel"><geom type="cylinder" size="0.1 0.02" density="500" euler="90 0 0" friction="1.2"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="10 10 0.1"/>
    <body name="chassis" pos="0 0 0.12">
      <joint type="free" name="root"/>
      <geom type="box" size="0.25 0.12 0.03" mass="4"/>
      <body name="left" pos="0.15 0.18 -0.02"><joint name="left" axis="0 1 0"/><geom class="wheel"/></body>
      <body name="right" pos="0.15 -0.18 -0.02"><joint name="right" axis="0 1 0"/><geom class="wheel"/></body>
      <body name="mast" pos="-0.1 0 0.05">
        <joint type="slide" axis="0 0 1" range="0 0.1" stiffness="900" damping="9"/>
        <joint name="pan" axis="0 0 1" springdamper="0.2 0.7" armature="0.02"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5"/>
      </body>
      <body name="caster" pos="-0.2 0 -0.08"><joint type="ball"/><geom size="0.04" density="300"/></body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="left"/>
    <velocity joint="right"/>
    <motor name="pan" joint="pan" forcerange="-2 2"/>
  </actuator>
  <sensor>
    <jointvel name="left_rate" joint="left"/><jointvel joint="right"/><velocimeter name="speed" site="box"/>
  </sensor>
  <worldbody><site name="box"/></worldbody>
</mujoco>"""
"""Free, slide and ball joints beside the hinges, wheels on velocity actuators without names, air
and wind."""

FOUR_BAR = """
<mujoco model="four_bar">
  <option timestep="0.0005" integrator="RK4"/>
  <default>
    <equality solref="0.005 1"/><joint axis="0 1 0" damping="0.05"/><geom type="capsule" size="0.02" contype="0"/>
  </default>
  <worldbody>
    <body name="crank"><joint name="crank"/><geom fromto="0 0 0 0 0 0.2"/>
      <body name="coupler" pos="0 0 0.2"><joint name="coupler" range="-170 170"/><geom fromto="0 0 0 0.5 0 0.1"/></body>
    </body>
    <body name="rocker" pos="0.5 0 0">
      <joint name="rocker"/><geom fromto="0 0 0 0 0 0.3"/><site name="tip" pos="0 0 0.3"/>
    </body>
  </worldbody>
  <equality><connect name="pin" body1="coupler" body2="rocker" anchor="0.5 0 0.1"/></equality>
  <actuator><position name="crank" joint="crank" kp="30" kv="1"/></actuator>
  <sensor><framepos name="tip" objtype="site" objname="tip"/></sensor>
  <keyframe><key name="straight"/><key name="turned" qpos="0.2 -0.2 0.1" ctrl="0.2"/></keyframe>
</mujoco>"""
"""A closed loop by a connect equality; keyframes that leave things out."""

MODELS = {
    "quadruped": (QUADRUPED, ["front_hip", "front_knee", "rear_hip", "rear_knee"]),
    "arm": (ARM, ["yaw", "pitch", "roll", "elbow", "left_finger"]),
    "rover": (ROVER, ["left", "right", "pan"]),
    "four_bar": (FOUR_BAR, ["crank", "rocker"]),
}
"""MJCF and the hinges that become elastic, by name."""
