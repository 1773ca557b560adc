"""Position loops that the gateway closes itself on the paper's machine: softer than the drives' own."""

TORQUE_LOOPS = {
    "cv": {
        "proportional_Nm_per_rad": 20,
        "integrating_Nm_per_rad_s": 60,
        "derivative_Nms_per_rad": 0.3,
        "torque_limit_Nm": 4.5,
    },
    "servo": {
        "proportional_Nm_per_rad": 15,
        "integrating_Nm_per_rad_s": 60,
        "derivative_Nms_per_rad": 0.18,
        "torque_limit_Nm": 4.5,
    },
}
