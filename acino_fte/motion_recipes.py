"""The motions that come with the simulator, as data.

The waves of the limbs were found by least squares: the paw on the ground moves backwards at the speed of
the animal (so that it hardly slips in the world), lifts and swings forward in between, and the joints
stay near a natural posture, inside their ranges, and as smooth as the process noise of the species has
them. Footfall order, stride rate and posture of the gallop follow Hildebrand 1959 (Motions of the running
cheetah and horse, J. Mammal. 40:481) and Hudson, Corr, Wilson 2012 (High speed galloping in the cheetah
and the racing greyhound, J. Exp. Biol. 215:2425): both hind limbs, the extended flight, both forelimbs,
the gathered flight with the spine flexed. The joint angles of the walk follow the shape of the normal
curves in Winter 2009 (Biomechanics and Motor Control of Human Movement, 4th ed.).

Angles in degrees, lengths in metres, lags and rates in strides.
"""

from __future__ import annotations

from acino_fte.motions import Recipe, Wave

_CHEETAH = (
    "neck.pitch",
    "back_torso.pitch",
    "tail_base.yaw",
    "[lr]_front_thigh.shoulder",
    "[lr]_back_calf.knee",
)


def _legs(front: dict[str, Wave], back: dict[str, Wave], landing: dict[str, float]) -> dict[str, Wave]:
    """The waves of four limbs from those of one front and one back limb, delayed to their landing."""
    joints = {}
    for leg, lag in landing.items():
        side, kind = leg.split("_")
        for joint, wave in (front if kind == "front" else back).items():
            joints[f"{side}_{kind}_{joint}"] = wave.delayed(lag)
    return joints


_GALLOP_FRONT = {
    "thigh.shoulder": Wave(36.8, ((1, 49.2, -141.0), (2, 7.3, 16.0), (3, 5.9, -157.0), (4, 0.3, 125.0))),
    "calf.knee": Wave(-64.5, ((1, 39.0, 7.0), (2, 6.5, 151.0), (3, 3.7, -79.0), (4, 3.1, 120.0))),
    "foot.ankle": Wave(18.9, ((1, 32.8, -83.0), (2, 8.0, 94.0), (3, 1.1, -42.0), (4, 0.2, -68.0))),
}
_GALLOP_BACK = {
    "thigh.hip": Wave(-26.6, ((1, 45.8, -118.0), (2, 6.0, -15.0), (3, 8.4, 148.0), (4, 2.6, 163.0))),
    "calf.knee": Wave(98.6, ((1, 13.7, 124.0), (2, 13.2, -71.0), (3, 8.8, -22.0), (4, 1.8, -60.0))),
    "foot.ankle": Wave(-51.7, ((1, 28.5, 80.0), (2, 11.3, -115.0), (3, 2.0, -25.0), (4, 0.4, 175.0))),
}
_FLEXED = 0.86 * 360  # the spine is most flexed in the middle of the gathered flight
_GALLOP_BODY = {
    "neck.pitch": Wave(-20, ((1, 4, -126),)),
    "front_torso.pitch": Wave(15, ((1, 9, -_FLEXED),)),
    "back_torso.pitch": Wave(-9, ((1, -17, -_FLEXED),)),
    "tail_base.pitch": Wave(12, ((1, 14, -36),)),
    "tail_mid.pitch": Wave(-18, ((1, 14, -108),)),
    "tail_base.yaw": Wave(0, ((0.5, 8, 0),)),
    "tail_mid.yaw": Wave(0, ((0.5, 10, -60),)),
}
_GALLOP_ROOT = {
    "up": Wave(0.808, ((1, 0.02, -108),)),
    "pitch": Wave(3, ((1, 3, -216),)),
}
_GALLOP_LANDING = {"l_back": 0.0, "r_back": 0.11, "r_front": 0.42, "l_front": 0.55}
_GALLOP_JOINTS = {**_GALLOP_BODY, **_legs(_GALLOP_FRONT, _GALLOP_BACK, _GALLOP_LANDING)}

GALLOP = Recipe(
    name="gallop",
    summary="cheetah, rotary gallop at 13 m/s with a flexing spine",
    rate=3.0,
    speed=13.0,
    joints=_GALLOP_JOINTS,
    root=_GALLOP_ROOT,
    needs=_CHEETAH,
)

TURN = Recipe(
    name="turn",
    summary="cheetah, gallop at 9 m/s on a curve of 25 m radius, leaning into it",
    rate=9.0 / 13.0 * 3.0,  # the length of the stride stays
    speed=9.0,
    joints={
        **_GALLOP_JOINTS,
        "neck.yaw": Wave(-4),
        "back_torso.yaw": Wave(-3, ((1, 3, 0),)),
        "tail_base.yaw": Wave(20, ((0.5, 15, 0),)),
        "tail_mid.yaw": Wave(15, ((0.5, 20, -60),)),
    },
    root={**_GALLOP_ROOT, "up": Wave(0.82, ((1, 0.02, -108),)), "yaw": Wave(5, ((1, 1.5, 0),))},
    curvature=1 / 25.0,
    lean=18.3,  # atan(v² / (g·radius))
    needs=_CHEETAH,
)

_TROT_FRONT = {
    "thigh.shoulder": Wave(23.9, ((1, 25.2, 160.0), (2, 11.1, -141.0), (3, 4.0, 93.0))),
    "calf.knee": Wave(-41.4, ((1, 19.9, -69.0), (2, 15.9, 19.0), (3, 6.2, -52.0))),
    "foot.ankle": Wave(12.4, ((1, 13.3, -97.0), (2, 0.8, -78.0), (3, 4.0, 120.0))),
}
_TROT_BACK = {
    "thigh.hip": Wave(-26.1, ((1, 26.7, -140.0), (2, 8.7, -3.0), (3, 2.7, 42.0))),
    "calf.knee": Wave(77.1, ((1, 11.3, 93.0), (2, 22.4, -148.0), (3, 1.3, 154.0))),
    "foot.ankle": Wave(-44.3, ((1, 17.7, 96.0), (2, 2.8, 53.0), (3, 3.0, -77.0))),
}
_TROT_LANDING = {"l_front": 0.0, "r_back": 0.03, "r_front": 0.5, "l_back": 0.53}

FLICK = Recipe(
    name="flick",
    summary="cheetah, trot at 2.4 m/s with wide flicks of the tail",
    rate=2.0,
    speed=2.4,
    joints={
        "neck.pitch": Wave(-20, ((2, 1.5, 0),)),
        "front_torso.pitch": Wave(17),
        "back_torso.pitch": Wave(-4, ((2, 2, 40),)),
        "tail_base.yaw": Wave(0, ((0.5, 60, -90), (1.5, 14, 0))),
        "tail_mid.yaw": Wave(0, ((0.5, 55, -150), (1.5, 22, -90))),
        "tail_base.pitch": Wave(20, ((1, 25, 40),)),
        "tail_mid.pitch": Wave(10, ((1, 25, -40),)),
        **_legs(_TROT_FRONT, _TROT_BACK, _TROT_LANDING),
    },
    root={"up": Wave(0.84, ((2, 0.012, 0),)), "pitch": Wave(3)},
    needs=_CHEETAH,
)

_HIP = Wave(-11, ((1, 20, 180), (2, 4, 60)))  # heel strike at zero; negative swings the leg forward
_KNEE = Wave(25, ((1, 20, 92), (2, 15, -157)))
_ANKLE = Wave(-2, ((1, 8, 120), (2, 8, -130)))
_ARM = Wave(4, ((1, 20, 0),))  # against the leg of its side

WALK = Recipe(
    name="walk",
    summary="human, walk at 1.4 m/s",
    rate=0.95,
    speed=1.4,
    joints={
        "l_thigh.flex": _HIP,
        "r_thigh.flex": _HIP.delayed(0.5),
        "l_shank.knee": _KNEE,
        "r_shank.knee": _KNEE.delayed(0.5),
        "l_foot.point": _ANKLE,
        "r_foot.point": _ANKLE.delayed(0.5),
        "l_upper_arm.flex": _ARM,
        "r_upper_arm.flex": _ARM.delayed(0.5),
        "l_forearm.elbow": Wave(-25, ((1, 8, 180),)),
        "r_forearm.elbow": Wave(-25, ((1, 8, 180),), lag=0.5),
        "*_upper_arm.abduct": Wave(6),
        "torso.yaw": Wave(0, ((1, 6, 180),)),
        "torso.pitch": Wave(3, ((2, 1, 0),)),
        "torso.roll": Wave(0, ((1, 2, 90),)),
    },
    root={
        "yaw": Wave(0, ((1, 4, 0),)),
        "roll": Wave(0, ((1, 3, -90),)),
        "pitch": Wave(2),
        "left": Wave(0, ((1, 0.02, -90),)),
    },
    needs=("*thigh.flex", "*shank.knee"),
    grounded=True,
)

RECIPES = (GALLOP, FLICK, TURN, WALK)
