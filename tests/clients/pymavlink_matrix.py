#!/usr/bin/env python3
"""A neutral client checks what a PX4-compatible autopilot answers: exit 0 only if every check held.

    pip install pymavlink==2.4.50
    ./pymavlink_matrix.py [udpin:127.0.0.1:14540]

Checks: the acknowledgement matrix, streams, parameters, TIMESYNC, gimbal control and its denial, OFFBOARD's rules on the
ground and in the air, loss of setpoints and their return, Hold against a resumed stream, loss of the ground station, the
default return on lost setpoints, takeoff in OFFBOARD, battery thresholds and their floor. The vehicle
must stand on the ground at the start, freshly booted. Each line printed is 'ok CHECK detail' or 'FAILED CHECK reason';
the last line is 'N passed, N failed'.
"""
import math
import os
import struct
import sys
import time

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil  # noqa: E402  (the variable above decides the protocol's version)

URL = next((a for a in sys.argv[1:] if ":" in a), "udpin:127.0.0.1:14540")
NAN = float("nan")
ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
HOLD, RETURN, LAND, OFFBOARD, TAKEOFF, MISSION = (4, 3), (4, 5), (4, 6), (6, 0), (4, 2), (4, 4)
passed, failed = 0, 0


class Client:
    """One connection: a ground station's heartbeat, the newest message of each type, and a setpoint stream."""

    def __init__(self):
        self.link = mavutil.mavlink_connection(URL, source_system=245, source_component=190)
        self.latest, self.count, self.texts = {}, {}, []
        self.setpoint, self.sent_at, self.beat_at = None, 0.0, 0.0
        self.mask, self.frame, self.target = 0x9F8, 1, 1
        self.slowest_ack_s = 0.0

    def turn(self):
        """Sends what is due and reads one message."""
        now = time.monotonic()
        if now - self.beat_at > 1.0 and self.link.target_system:
            self.link.mav.heartbeat_send(6, 8, 0, 0, 0)
            self.beat_at = now
        if self.setpoint is not None and now - self.sent_at > 0.05:
            x, y, z, yaw = self.setpoint
            self.link.mav.set_position_target_local_ned_send(
                0, self.target, 1, self.frame, self.mask, x, y, z, 0, 0, 0, 0, 0, 0, yaw, 0)
            self.sent_at = now
        message = self.link.recv_match(blocking=True, timeout=0.01)
        if message is not None and message.get_srcComponent() == 1:
            kind = message.get_type()
            self.latest[kind] = message
            self.count[kind] = self.count.get(kind, 0) + 1
            if kind == "STATUSTEXT":
                self.texts.append(message.text)
        return message

    def until(self, holds, timeout_s, what):
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            self.turn()
            value = holds()
            if value:
                return value
        raise AssertionError(f"{what}: not within {timeout_s} s")

    def run(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.turn()

    def next(self, kind, timeout_s=3.0):
        before = self.count.get(kind, 0)
        self.until(lambda: self.count.get(kind, 0) > before, timeout_s, kind)
        return self.latest[kind]

    def command(self, number, params, system=1, component=1, source=None):
        """Sends a COMMAND_LONG and gives the result of its acknowledgement, None where none comes."""
        params = list(params) + [NAN] * (7 - len(params))
        mav = self.link.mav
        own = mav.srcComponent
        mav.srcComponent = source or own
        mav.command_long_send(system, component, number, 0, *params)
        mav.srcComponent = own
        sent = time.monotonic()
        end = sent + 0.7
        while time.monotonic() < end:
            message = self.turn()
            if message is not None and message.get_type() == "COMMAND_ACK" and message.command == number:
                self.slowest_ack_s = max(self.slowest_ack_s, time.monotonic() - sent)
                return message.result
        return None

    def mode(self):
        custom = self.latest["HEARTBEAT"].custom_mode
        return (custom >> 16 & 0xFF, custom >> 24 & 0xFF)

    def request(self, number, kind):
        """Asks for one message and gives it; it may come before or after the acknowledgement."""
        self.latest.pop(kind, None)
        equal(self.command(512, [number]), ACCEPTED)
        self.until(lambda: kind in self.latest, 1, kind)
        return self.latest[kind]

    def set_mode(self, mode):
        return self.command(176, [1, mode[0], mode[1]])

    def armed(self):
        return bool(self.latest["HEARTBEAT"].base_mode & 128)

    def can_arm(self):
        return bool(self.latest["SYS_STATUS"].onboard_control_sensors_health & 0x10000000)

    def height(self):
        return -self.latest["LOCAL_POSITION_NED"].z

    def wait_mode(self, mode, timeout_s=4.0):
        self.until(lambda: self.mode() == mode, timeout_s, f"mode {mode}")

    def set_param(self, name, value, kind):
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if kind == 6 else value
        self.latest.pop("PARAM_VALUE", None)
        self.link.mav.param_set_send(1, 1, name.encode(), wire, kind)
        self.until(lambda: "PARAM_VALUE" in self.latest, 2, name)
        got = self.latest["PARAM_VALUE"]
        assert got.param_id == name and got.param_type == kind, got
        value_got = struct.unpack("<i", struct.pack("<f", got.param_value))[0] if kind == 6 else got.param_value
        assert abs(value_got - value) < 1e-4, (value_got, value)


def check(name, action):
    global passed, failed
    try:
        detail = action()
        passed += 1
        print(f"ok {name} {detail if detail is not None else ''}".rstrip(), flush=True)
    except Exception as error:  # every failure is a result of this script
        failed += 1
        print(f"FAILED {name} {error!r}", flush=True)


def equal(got, wanted):
    assert got == wanted, f"got {got}, expected {wanted}"
    return got


c = Client()
INT, REAL = 6, 9


def connect():
    c.link.wait_heartbeat(timeout=15)
    heartbeat = c.next("HEARTBEAT")
    equal((heartbeat.type, heartbeat.autopilot, heartbeat.mavlink_version), (2, 12, 3))


def discovery():
    equal(c.request(148, "AUTOPILOT_VERSION").flight_sw_version >> 16, 0x0112)
    origin = c.request(49, "GPS_GLOBAL_ORIGIN")
    c.request(242, "HOME_POSITION")
    return f"origin {origin.latitude} {origin.longitude} {origin.altitude}"


def stream_rates():
    c.next("HEARTBEAT")
    before = dict(c.count)
    started = c.latest["SYSTEM_TIME"].time_boot_ms if "SYSTEM_TIME" in c.latest else c.next("SYSTEM_TIME").time_boot_ms
    c.run(6)
    seconds = (c.next("SYSTEM_TIME").time_boot_ms - started) / 1000.0
    expected = {"ATTITUDE": 100, "ATTITUDE_QUATERNION": 50, "GLOBAL_POSITION_INT": 50, "LOCAL_POSITION_NED": 30,
                "ODOMETRY": 30, "VFR_HUD": 10, "POSITION_TARGET_LOCAL_NED": 10, "EXTENDED_SYS_STATE": 5, "SYS_STATUS": 5}
    for kind, hz in expected.items():
        got = (c.count.get(kind, 0) - before.get(kind, 0)) / seconds
        assert 0.8 * hz <= got <= 1.2 * hz, f"{kind} at {got:.1f} Hz, expected {hz}"
    odometry = c.latest["ODOMETRY"]
    equal((odometry.frame_id, odometry.child_frame_id, odometry.estimator_type), (1, 1, 8))


def interval():
    equal(c.command(511, [32, 10000]), ACCEPTED)
    before, started = c.count["LOCAL_POSITION_NED"], c.next("ATTITUDE").time_boot_ms
    c.run(3)
    seconds = (c.latest["ATTITUDE"].time_boot_ms - started) / 1000.0
    got = (c.count["LOCAL_POSITION_NED"] - before) / seconds
    assert 85 < got < 110, got
    return f"{got:.1f} Hz"


def timesync():
    sent = time.monotonic_ns()
    c.latest.pop("TIMESYNC", None)
    c.link.mav.timesync_send(0, sent)
    c.until(lambda: "TIMESYNC" in c.latest and c.latest["TIMESYNC"].tc1 != 0, 1, "reply")
    equal(c.latest["TIMESYNC"].ts1, sent)
    boot_ms = c.next("ATTITUDE").time_boot_ms
    assert abs(c.latest["TIMESYNC"].tc1 / 1e6 - boot_ms) < 1000, c.latest["TIMESYNC"]


def params():
    c.latest.pop("PARAM_VALUE", None)
    c.link.mav.param_request_read_send(1, 1, b"MIS_TAKEOFF_ALT", -1)
    c.until(lambda: "PARAM_VALUE" in c.latest, 2, "PARAM_VALUE")
    equal(c.latest["PARAM_VALUE"].param_type, REAL)
    c.set_param("COM_OBL_RC_ACT", 5, INT)
    c.set_param("MPC_XY_VEL_MAX", 8.0, REAL)


def gcs_needed():
    """NAV_DLL_ACT=2 refuses to arm without a ground station; this client is one, so it goes quiet first."""
    c.set_param("NAV_DLL_ACT", 2, INT)
    c.beat_at = time.monotonic() + 13
    c.run(12)
    equal(c.command(400, [1]), REJECTED)
    c.beat_at = 0.0
    c.set_param("NAV_DLL_ACT", 0, INT)
    c.until(c.can_arm, 3, "can arm again")


def wrong_target():
    equal(c.command(512, [148], system=77), None)
    equal(c.command(512, [148], component=154), None)


def gimbal_denied():
    equal(c.command(1000, [-30, 0, NAN, NAN, 12, 0, 0]), DENIED)


def gimbal_control():
    information = c.request(280, "GIMBAL_MANAGER_INFORMATION")
    equal(information.gimbal_device_id, 1)
    equal(c.command(1001, [245, 190, -1, -1, NAN, NAN, 0]), ACCEPTED)
    status = c.next("GIMBAL_MANAGER_STATUS")
    equal((status.primary_control_sysid, status.primary_control_compid), (245, 190))
    equal(c.command(1000, [-40, 20, NAN, NAN, 12, 0, 0]), ACCEPTED)
    c.run(2)
    attitude = c.next("GIMBAL_DEVICE_ATTITUDE_STATUS")
    equal(attitude.flags, 0b101100)
    w, x, y, z = attitude.q
    pitch = math.degrees(math.asin(2 * (w * y - z * x)))
    yaw = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    assert abs(pitch + 40) < 1 and abs(yaw - 20) < 1, (pitch, yaw)
    equal(c.command(1000, [0, 0, NAN, NAN, 12, 0, 0], source=191), DENIED)
    return f"pitch {pitch:.1f} yaw {yaw:.1f}, range {math.degrees(information.pitch_min):.0f}"


def gimbal_message():
    half = math.radians(-25) / 2
    c.link.mav.gimbal_manager_set_attitude_send(1, 1, 12, 0, [math.cos(half), 0, math.sin(half), 0], NAN, NAN, NAN)
    c.run(2)
    w, x, y, z = c.next("GIMBAL_DEVICE_ATTITUDE_STATUS").q
    pitch = math.degrees(math.asin(2 * (w * y - z * x)))
    assert abs(pitch + 25) < 1, pitch


def gimbal_set_pitchyaw_is_ignored():
    """Message 287 has no handler in PX4: no answer and no motion."""
    before = c.next("GIMBAL_DEVICE_ATTITUDE_STATUS").q
    for _ in range(10):
        c.link.mav.gimbal_manager_set_pitchyaw_send(1, 1, 12, 0, math.radians(-60), 0, NAN, NAN)
        c.run(0.1)
    after = c.next("GIMBAL_DEVICE_ATTITUDE_STATUS").q
    assert max(abs(a - b) for a, b in zip(before, after)) < 0.02, (before, after)


def no_texts_without_a_ground_station():
    """STATUSTEXT goes only where a ground station's heartbeat was heard."""
    c.beat_at = time.monotonic() + 14
    c.run(12)
    c.texts.clear()
    equal(c.set_mode((3, 0)), ACCEPTED)
    equal(c.command(400, [1]), REJECTED)
    c.run(1)
    equal(c.texts, [])
    c.beat_at = 0.0
    c.run(0.5)
    equal(c.command(400, [1]), REJECTED)
    c.until(lambda: any("Arming denied" in t for t in c.texts), 2, "the text with a ground station")
    equal(c.set_mode(HOLD), ACCEPTED)
    c.until(c.can_arm, 5, "PREARM_CHECK in Hold")


def unused_parameters():
    """Non-zero values where a command takes none are denied before anything else is looked at."""
    equal(c.command(21, [0, 0, 5]), DENIED)
    equal(c.command(22, [NAN, 5]), DENIED)
    equal(c.command(22, [NAN, NAN, 5]), DENIED)
    equal(c.command(176, [1, 4, 3, 5]), DENIED)
    equal(c.command(176, [1, 4, 3, 0, 0, 0, 5]), DENIED)


def offboard_without_stream_on_ground():
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)
    c.run(1)
    assert not c.can_arm(), "PREARM_CHECK is set in OFFBOARD without a stream"
    equal(c.command(400, [1]), REJECTED)
    equal(c.latest["HEARTBEAT"].system_status, 0)
    equal(c.set_mode(HOLD), ACCEPTED)
    c.until(c.can_arm, 5, "PREARM_CHECK in Hold")


def takeoff():
    equal(c.command(400, [1]), ACCEPTED)
    c.until(c.armed, 2, "armed")
    equal(c.command(400, [1]), ACCEPTED)
    equal(c.command(22, []), ACCEPTED)
    c.until(lambda: c.latest["EXTENDED_SYS_STATE"].landed_state == 3, 6, "landed_state 3")
    c.until(lambda: c.height() > 2.0, 15, "height")
    c.wait_mode(HOLD, 10)
    equal(c.latest["EXTENDED_SYS_STATE"].landed_state, 2)


def in_the_air():
    equal(c.set_mode(OFFBOARD), REJECTED)
    equal(c.command(400, [0]), REJECTED)
    equal(c.set_mode((3, 0)), REJECTED)


def offboard_at_the_first_setpoint():
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.run(0.06)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)
    c.until(lambda: abs(c.height() - 3) < 0.3, 8, "3 m")


def setpoint_kept(before):
    target = c.next("POSITION_TARGET_LOCAL_NED")
    equal((round(target.x), round(target.z)), before)


def speed_change_is_accepted_without_effect():
    """178 does nothing to setpoints of a client."""
    equal(c.command(178, [1, 0.5]), ACCEPTED)
    c.setpoint = (5.0, 0.0, -3.0, 0.0)
    fastest, end = 0.0, time.monotonic() + 3
    while time.monotonic() < end:
        c.turn()
        fastest = max(fastest, c.latest["LOCAL_POSITION_NED"].vx)
    assert fastest > 2.0, fastest
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.until(lambda: abs(c.latest["LOCAL_POSITION_NED"].x) < 0.3, 10, "back")
    return f"{fastest:.1f} m/s"


def empty_setpoint_is_dropped():
    c.setpoint, c.mask = (9.0, 0.0, -9.0, 0.0), 0xDFF
    c.run(0.5)
    setpoint_kept((0, -3))
    c.setpoint, c.mask = (0.0, 0.0, -3.0, 0.0), 0x9F8
    c.run(0.5)
    equal(c.mode(), OFFBOARD)


def targets_of_setpoints():
    """System 0 is everybody; another system's setpoints are not this vehicle's."""
    c.setpoint, c.target = (2.0, 0.0, -3.0, 0.0), 0
    c.until(lambda: abs(c.latest["LOCAL_POSITION_NED"].x - 2) < 0.4, 10, "flown for target 0")
    c.setpoint, c.target = (0.0, 0.0, -3.0, 0.0), 1
    c.until(lambda: abs(c.latest["LOCAL_POSITION_NED"].x) < 0.4, 10, "back")
    c.setpoint, c.target = (9.0, 0.0, -3.0, 0.0), 77
    c.run(0.6)
    setpoint_kept((0, -3))
    c.setpoint, c.target = (0.0, 0.0, -3.0, 0.0), 1
    c.run(0.5)
    equal(c.mode(), OFFBOARD)


def velocity_in_the_bodys_frame():
    """Frame 8 takes velocities: forward is where the nose points, here north."""
    c.setpoint = None
    forward = 0.0
    for _ in range(40):
        c.link.mav.set_position_target_local_ned_send(0, 1, 1, 8, 0xDC7, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0)
        c.run(0.05)
        forward = max(forward, c.latest["LOCAL_POSITION_NED"].vx)
    assert 0.6 < forward < 1.5, forward
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.until(lambda: abs(c.latest["LOCAL_POSITION_NED"].x) < 0.4, 10, "back")
    equal(c.mode(), OFFBOARD)
    return f"{forward:.2f} m/s"


def modes_of_the_autopilot():
    """176 with AUTO modes: Land and Return fly, a mission that is not there does not; OFFBOARD takes it back."""
    for mode in (HOLD, LAND, RETURN):
        equal(c.set_mode(mode), ACCEPTED)
        c.wait_mode(mode)
    equal(c.set_mode(MISSION), REJECTED)
    equal(c.mode(), RETURN)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)
    c.until(lambda: abs(c.height() - 3) < 0.4, 10, "3 m again")


def unknown_frame_is_dropped():
    c.setpoint = None
    for _ in range(20):
        c.link.mav.set_position_target_local_ned_send(0, 1, 1, 20, 0x9F8, 9, 9, -9, 0, 0, 0, 0, 0, 0, 0, 0)
        c.run(0.01)
    target = c.next("POSITION_TARGET_LOCAL_NED")
    equal((round(target.x), round(target.z)), (0, -3))
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.run(0.5)
    c.wait_mode(OFFBOARD)


def a_short_gap_is_harmless():
    c.setpoint = None
    c.run(0.7)
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.run(1.5)
    equal(c.mode(), OFFBOARD)
    equal(c.latest["HEARTBEAT"].system_status, 4)


def lost_setpoints_hold():
    c.setpoint = None
    lost = time.monotonic()
    c.wait_mode(HOLD, 5)
    after = time.monotonic() - lost
    assert 0.9 < after < 2.6, after
    equal(c.latest["HEARTBEAT"].system_status, 5)
    mode = c.next("CURRENT_MODE", 4)
    equal((mode.intended_custom_mode >> 16 & 0xFF, mode.custom_mode >> 16 & 0xFF), (6, 4))
    return f"after {after:.1f} s"


def resumed_stream_flies_again():
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.wait_mode(OFFBOARD, 3)


def hold_stands_against_a_resumed_stream():
    c.setpoint = None
    c.wait_mode(HOLD, 5)
    equal(c.set_mode(HOLD), ACCEPTED)
    c.setpoint = (0.0, 0.0, -3.0, 0.0)
    c.run(2.5)
    equal(c.mode(), HOLD)
    equal(c.latest["HEARTBEAT"].system_status, 4)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)


def velocity_limit():
    c.set_param("MPC_XY_VEL_MAX", 2.0, REAL)
    c.setpoint = (8.0, 0.0, -3.0, 0.0)
    fastest, end = 0.0, time.monotonic() + 6
    while time.monotonic() < end:
        c.turn()
        fastest = max(fastest, c.latest["LOCAL_POSITION_NED"].vx)
    assert 1.4 < fastest < 2.2, fastest
    c.set_param("MPC_XY_VEL_MAX", 12.0, REAL)
    return f"{fastest:.2f} m/s"


def geofence_holds():
    c.set_param("GF_MAX_HOR_DIST", 10.0, REAL)
    c.setpoint = (20.0, 0.0, -3.0, 0.0)
    c.wait_mode(HOLD, 8)
    equal(c.latest["HEARTBEAT"].system_status, 5)
    c.setpoint = (3.0, 0.0, -3.0, 0.0)
    c.run(1.5)
    equal(c.mode(), HOLD)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)
    c.until(lambda: c.latest["LOCAL_POSITION_NED"].x < 4, 10, "back inside")
    c.set_param("GF_MAX_HOR_DIST", 0.0, REAL)


def land_while_the_stream_goes_on():
    equal(c.command(21, []), ACCEPTED)
    c.wait_mode(LAND)
    c.until(lambda: c.latest["EXTENDED_SYS_STATE"].landed_state == 4, 3, "landing")
    c.until(lambda: c.latest["EXTENDED_SYS_STATE"].landed_state == 1, 25, "landed")
    landed = time.monotonic()
    c.until(lambda: not c.armed(), 6, "disarmed")
    after = time.monotonic() - landed
    assert 0.8 < after < 4.0, after
    c.wait_mode(OFFBOARD, 3)
    c.setpoint = None
    c.run(1.5)
    assert not c.can_arm(), "OFFBOARD is kept after landing, and cannot be armed in without a stream"
    equal(c.set_mode(HOLD), ACCEPTED)
    c.until(c.can_arm, 5, "PREARM_CHECK in Hold")
    return f"disarmed after {after:.1f} s"


def takeoff_in_offboard():
    """No TAKEOFF command: armed in OFFBOARD, a setpoint above lifts it."""
    c.setpoint = (0.0, 0.0, -2.5, 0.0)
    c.run(1.2)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.until(c.can_arm, 5, "PREARM_CHECK in OFFBOARD with a stream")
    equal(c.command(400, [1]), ACCEPTED)
    started = time.monotonic()
    c.until(lambda: c.height() > 2.0, 12, "2 m")
    return f"2 m after {time.monotonic() - started:.1f} s"


def ground_station_lost_in_flight():
    """NAV_DLL_ACT=2: Hold, then return; a station that is back cancels nothing until a mode is commanded."""
    c.set_param("NAV_DLL_ACT", 2, INT)
    c.beat_at = time.monotonic() + 60
    c.until(lambda: c.mode() == HOLD, 14, "Hold")
    equal(c.latest["HEARTBEAT"].system_status, 5)
    c.wait_mode(RETURN, 8)
    c.beat_at = 0.0
    c.run(2)
    equal(c.mode(), RETURN)
    c.set_param("NAV_DLL_ACT", 0, INT)
    equal(c.set_mode(OFFBOARD), ACCEPTED)
    c.wait_mode(OFFBOARD)
    c.until(lambda: abs(c.height() - 2.5) < 0.5, 40, "back at 2.5 m")


def lost_setpoints_return_by_default():
    """COM_OBL_RC_ACT=0 without a remote control."""
    c.set_param("COM_OBL_RC_ACT", 0, INT)
    c.setpoint = None
    c.wait_mode(RETURN, 5)
    equal(c.latest["HEARTBEAT"].system_status, 5)
    c.set_param("COM_OBL_RC_ACT", 5, INT)
    equal(c.set_mode(LAND), ACCEPTED)
    c.wait_mode(LAND)
    c.until(lambda: not c.armed(), 40, "disarmed")
    equal(c.set_mode(HOLD), ACCEPTED)
    c.until(c.can_arm, 5, "PREARM_CHECK in Hold")


def preflight_disarm():
    equal(c.command(400, [1]), ACCEPTED)
    started = time.monotonic()
    c.until(c.armed, 2, "armed")
    c.until(lambda: not c.armed(), 15, "disarmed")
    after = time.monotonic() - started
    assert 9.0 < after < 12.5, after
    return f"after {after:.1f} s"


def battery_floor():
    """SIM_BAT_MIN_PCT stops the drain; the vehicle stays in the air for the next check."""
    equal(c.command(400, [1]), ACCEPTED)
    equal(c.command(22, []), ACCEPTED)
    c.wait_mode(HOLD, 20)
    c.until(lambda: c.height() > 2.0, 10, "height")
    c.set_param("SIM_BAT_MIN_PCT", 50.0, REAL)
    c.set_param("SIM_BAT_DRAIN", 10.0, REAL)
    c.until(lambda: "BATTERY_STATUS" in c.latest and c.latest["BATTERY_STATUS"].battery_remaining <= 50, 10, "50 %")
    c.run(3)
    equal(c.next("BATTERY_STATUS", 4).battery_remaining, 50)
    equal(c.mode(), HOLD)


def battery():
    """Drains quickly: warning, then Hold and return at critical, then landing at the emergency level."""
    c.set_param("SIM_BAT_DRAIN", 60.0, REAL)
    c.set_param("COM_LOW_BAT_ACT", 3, INT)
    c.set_param("SIM_BAT_MIN_PCT", 0.0, REAL)
    states = []

    def charge():
        state = c.latest["BATTERY_STATUS"].charge_state if "BATTERY_STATUS" in c.latest else 1
        if not states or states[-1] != state:
            states.append(state)
        return state

    equal(charge(), 1)
    c.until(lambda: charge() == 2, 70, "low")
    c.set_param("SIM_BAT_DRAIN", 300.0, REAL)
    equal(c.mode(), HOLD)
    equal(c.latest["HEARTBEAT"].system_status, 4)
    # BATTERY_STATUS comes every 2 s: slow enough that no level passes between two of them.
    c.set_param("SIM_BAT_DRAIN", 200.0, REAL)
    c.until(lambda: charge() == 3, 40, "critical")
    c.set_param("SIM_BAT_DRAIN", 1000.0, REAL)
    c.until(lambda: c.latest["HEARTBEAT"].system_status == 5, 3, "failsafe")
    c.wait_mode(RETURN, 8)
    c.set_param("SIM_BAT_DRAIN", 200.0, REAL)
    c.wait_mode(LAND, 40)
    c.until(lambda: charge() == 4, 4, "emergency")
    c.until(lambda: not c.armed(), 60, "disarmed")
    equal(states, [1, 2, 3, 4])


def acknowledgements_are_quick():
    """Measured 10 ms on PX4; clients give up after 500."""
    assert c.slowest_ack_s < 0.25, c.slowest_ack_s
    return f"at most {c.slowest_ack_s * 1e3:.0f} ms"


def texts():
    assert any("Disarming denied" in t for t in c.texts), c.texts
    assert any("Arming denied" in t for t in c.texts), c.texts


check("connect", connect)
check("ready", lambda: c.until(lambda: "SYS_STATUS" in c.latest and c.can_arm(), 30, "PREARM_CHECK"))
check("discovery", discovery)
check("stream-rates", stream_rates)
check("set-message-interval", interval)
check("timesync", timesync)
check("parameters", params)
check("ack-unknown-command", lambda: equal(c.command(31999, [0]), UNSUPPORTED))
check("ack-unused-parameter", lambda: equal(c.command(400, [1, 0, 7, 0, 0, 0, 0]), DENIED))
check("ack-unused-parameter-of-return", lambda: equal(c.command(20, [1]), DENIED))
check("ack-unknown-message", lambda: equal(c.command(512, [9999]), DENIED))
check("ack-legacy-request", lambda: equal(c.command(520, [1]), UNSUPPORTED))
check("ack-unused-parameters-of-flight", unused_parameters)
check("no-ack-for-another-target", wrong_target)
check("gimbal-denied-without-control", gimbal_denied)
check("gimbal-control", gimbal_control)
check("gimbal-set-attitude", gimbal_message)
check("gimbal-set-pitchyaw-ignored", gimbal_set_pitchyaw_is_ignored)
check("arming-needs-ground-station", gcs_needed)
check("no-texts-without-ground-station", no_texts_without_a_ground_station)
check("offboard-on-the-ground-without-stream", offboard_without_stream_on_ground)
check("takeoff", takeoff)
check("rejections-in-the-air", in_the_air)
check("offboard-at-the-first-setpoint", offboard_at_the_first_setpoint)
check("unknown-frame-is-dropped", unknown_frame_is_dropped)
check("empty-setpoint-is-dropped", empty_setpoint_is_dropped)
check("setpoints-by-target", targets_of_setpoints)
check("velocity-in-body-frame", velocity_in_the_bodys_frame)
check("speed-change-without-effect", speed_change_is_accepted_without_effect)
check("auto-modes", modes_of_the_autopilot)
check("short-gap-is-harmless", a_short_gap_is_harmless)
check("lost-setpoints-hold", lost_setpoints_hold)
check("resumed-stream-flies-again", resumed_stream_flies_again)
check("hold-stands-against-resumed-stream", hold_stands_against_a_resumed_stream)
check("velocity-limit", velocity_limit)
check("geofence-holds", geofence_holds)
check("land-while-the-stream-goes-on", land_while_the_stream_goes_on)
check("takeoff-in-offboard", takeoff_in_offboard)
check("ground-station-lost-in-flight", ground_station_lost_in_flight)
check("lost-setpoints-return-by-default", lost_setpoints_return_by_default)
check("preflight-disarm", preflight_disarm)
check("battery-floor", battery_floor)
check("battery-warns-returns-lands", battery)
check("ack-latency", acknowledgements_are_quick)
check("texts", texts)
print(f"{passed} passed, {failed} failed")
sys.exit(1 if failed else 0)
