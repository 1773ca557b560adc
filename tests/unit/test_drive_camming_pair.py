"""Two emulated drives, the second camming on the first one's TPDO with a real cam image from its profile slot."""

from math import cos, tau

import pytest
from drive_bench import Bench

from drivers.frame import Frame
from mechanism.cam_image import CamImage, CamImageFault, decode_cam_image, encode
from sim_drive.device.cia402 import PowerState

POINTS = 256
AMPLITUDE = 400.0
TABLE = CamImage(8, 4096, 0, tuple(round(256 * AMPLITUDE * (1 - cos(tau * i / POINTS))) for i in range(POINTS)))
IMAGE = encode(TABLE)


def make_pair() -> tuple[Bench, Bench]:
    cv = Bench(node_id=1)
    cv.map_cyclic()
    cv.enable()
    cv.follows = True
    cv.drive.axis.latch = lambda now_ns: (cv.shaft, 0.0, 0)
    servo = Bench(node_id=2, decode=decode_cam_image)
    assert servo.download(0x3000, 1, IMAGE) == 0
    servo.must(0x3000, 2, 1, 1)
    assert servo.read(0x3000, 3) == 2
    assert servo.read(0x3000, 6) == POINTS
    servo.must(0x3010, 0, 1, 1)
    servo.map_rpdo(2, 0x181, 255, [0x00060010, 0x30110020, 0x00030010])
    servo.map_tpdo(1, 0x182, 1, [0x60410010, 0x60640020, 0x60770010])
    servo.nmt(0x01)
    servo.enable(mode=-2)
    servo.follows = True
    return cv, servo


def test_the_slave_is_on_the_cam_one_cycle_behind_the_master():
    cv, servo = make_pair()
    for cycle in range(1, 2200):
        cv.set_point(0x0F, 4 * cycle)
        frames = cv.sync()
        servo.sync()
        assert len(frames) == 1
        servo.drive.receive(Frame(0x181, bytes.fromhex(frames[0].removeprefix("181#"))), servo.now_ns)
        servo.sent()
        cv.tick()
        servo.tick()
        at_sync = 4 * (cycle - 1)
        expected = AMPLITUDE * (1 - cos(tau * at_sync / 4096))
        assert servo.drive.position_demand_counts == pytest.approx(expected, abs=0.02), cycle
    assert servo.drive.power_state is PowerState.OPERATION_ENABLED
    assert cv.shaft == 4 * 2199
    assert servo.statusword & 0x1000


def test_a_flipped_bit_is_refused_with_the_decoders_reason():
    servo = Bench(node_id=2, decode=decode_cam_image)
    damaged = bytearray(IMAGE)
    damaged[100] ^= 0x10
    assert servo.download(0x3000, 1, bytes(damaged)) == 0
    servo.must(0x3000, 2, 1, 1)
    assert servo.read(0x3000, 3) == 3
    assert servo.read(0x3000, 4) == CamImageFault.WRONG_CRC
