//! What the autopilot says, decoded: one place that reads MAVLink messages into plain values in the world's frames.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use mavlink::dialects::common::{MavLandedState, MavMessage, MavModeFlag, MavState, MavSysStatusSensor};
use shared_types::messages::check::FARTHEST;
use shared_types::messages::{ChargeState, FlightMode};

use crate::frames::{EarthOrigin, WorldTransform, enu_from_flu, quaternion, swap_frd_flu, swap_ned_enu};
use crate::timesync::TimeSync;

/// Health bit "can arm in the current mode".
const PREARM_BIT: u32 = 0x1000_0000;
/// Health bit of the remote control.
const RC_BIT: u32 = 0x1_0000;
/// A fix older than this is not fresh, nanoseconds.
const FRESH_NS: u64 = 500_000_000;
/// "VANTAGE1": the unique id of Vantage's simulator.
const SIMULATOR_UID: u64 = 0x5641_4e54_4147_4531;
/// How long attitudes are kept to resolve the gimbal's yaw, nanoseconds.
const HISTORY_NS: u64 = 1_000_000_000;

/// Mode of PX4's custom mode word.
#[must_use]
pub fn flight_mode(custom_mode: u32) -> FlightMode {
    match ((custom_mode >> 16) & 0xff, (custom_mode >> 24) & 0xff) {
        (0, _) => FlightMode::Unknown,
        (1..=3 | 5 | 7 | 11, _) => FlightMode::Pilot,
        (4, 2) => FlightMode::Takeoff,
        (4, 3) => FlightMode::Hold,
        (4, 5) => FlightMode::Return,
        (4, 6 | 9) => FlightMode::Land,
        (6, _) => FlightMode::Offboard,
        _ => FlightMode::Other,
    }
}

/// An attitude `world_from_body` at a mission time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttitudeSample {
    /// Mission time.
    pub stamp_ns: u64,
    /// ENU from FLU.
    pub world_from_body: DQuat,
}

/// Everything heard of the vehicle.
#[derive(Debug, Clone)]
pub struct Telemetry {
    /// Position in the world, metres; stamp 0: never heard.
    pub position_m: DVec3,
    /// Mission time of position and velocity.
    pub position_stamp_ns: u64,
    /// Velocity in the world, m/s.
    pub velocity_mps: DVec3,
    /// Attitudes of the last second, oldest first.
    pub attitudes: VecDeque<AttitudeSample>,
    /// Rates about the body's axes (FLU), rad/s.
    pub body_rates_radps: DVec3,
    /// Mode now, and the one last commanded.
    pub mode: FlightMode,
    /// The mode that was last commanded by anybody; `Unknown` when the autopilot does not say.
    pub intended: FlightMode,
    /// Motors run.
    pub armed: bool,
    /// The autopilot calls its state critical: a failsafe acts.
    pub critical: bool,
    /// On the ground, as far as known.
    pub landed: Option<bool>,
    /// It can arm in its present mode.
    pub armable: bool,
    /// A remote control is there and healthy.
    pub remote_control: bool,
    /// Charge left, 0 to 1; negative: not known.
    pub battery_fraction: f64,
    /// What the battery says.
    pub charge: ChargeState,
    /// Home, local ENU, and its height above the sea, metres.
    pub home: Option<(DVec3, f64)>,
    /// Wind in the world, m/s.
    pub wind_mps: DVec3,
    /// AUTOPILOT_VERSION's unique id; `None` until it was heard.
    pub uid: Option<u64>,
    /// Mission time of the last message.
    pub heard_ns: u64,
    /// Mission time of the last heartbeat.
    pub heartbeat_ns: u64,
    /// Heartbeats heard.
    pub heartbeats: u64,
    /// The last warning in words.
    pub text: String,
    odometry_ns: u64,
    last_boot_ns: u64,
    /// How often the autopilot's clock went back: it was started again.
    pub reboots: u32,
}

impl Default for Telemetry {
    fn default() -> Self {
        Self {
            position_m: DVec3::ZERO,
            position_stamp_ns: 0,
            velocity_mps: DVec3::ZERO,
            attitudes: VecDeque::new(),
            body_rates_radps: DVec3::ZERO,
            mode: FlightMode::Unknown,
            intended: FlightMode::Unknown,
            armed: false,
            critical: false,
            landed: None,
            armable: false,
            remote_control: false,
            battery_fraction: -1.0,
            charge: ChargeState::Unknown,
            home: None,
            wind_mps: DVec3::ZERO,
            uid: None,
            heard_ns: 0,
            heartbeat_ns: 0,
            heartbeats: 0,
            text: String::new(),
            odometry_ns: 0,
            last_boot_ns: 0,
            reboots: 0,
        }
    }
}

impl Telemetry {
    /// The newest attitude.
    #[must_use]
    pub fn attitude(&self) -> Option<AttitudeSample> {
        self.attitudes.back().copied()
    }

    /// The attitude at a mission time, interpolated; the nearest where none surrounds it. `None` when none was heard.
    #[must_use]
    pub fn attitude_at(&self, stamp_ns: u64) -> Option<DQuat> {
        let after = self.attitudes.partition_point(|sample| sample.stamp_ns <= stamp_ns);
        match (after.checked_sub(1).and_then(|i| self.attitudes.get(i)), self.attitudes.get(after)) {
            (Some(a), Some(b)) => {
                #[expect(clippy::cast_precision_loss, reason = "milliseconds")]
                let t = (stamp_ns - a.stamp_ns) as f64 / (b.stamp_ns - a.stamp_ns).max(1) as f64;
                Some(a.world_from_body.slerp(b.world_from_body, t))
            }
            (a, b) => a.or(b).map(|sample| sample.world_from_body),
        }
    }

    /// Whether position and attitude are known and fresh, and home is known.
    #[must_use]
    pub fn ready(&self, now_ns: u64) -> bool {
        let fresh = |stamp_ns: u64| stamp_ns > 0 && now_ns.saturating_sub(stamp_ns) < FRESH_NS;
        fresh(self.position_stamp_ns)
            && self.attitude().is_some_and(|sample| fresh(sample.stamp_ns))
            && self.home.is_some()
    }

    /// After an absence: the modes are not known until they are heard again.
    pub fn forget_modes(&mut self) {
        self.mode = FlightMode::Unknown;
        self.intended = FlightMode::Unknown;
    }

    /// Whether the autopilot is Vantage's own simulator.
    #[must_use]
    pub fn is_our_simulator(&self) -> bool {
        self.uid == Some(SIMULATOR_UID)
    }

    /// Whether it is in the air: armed and not known to stand on the ground.
    #[must_use]
    pub fn in_air(&self) -> bool {
        self.armed && self.landed != Some(true)
    }

    fn stamp(&mut self, now_ns: u64, boot_ns: u64, sync: &mut TimeSync) -> u64 {
        if boot_ns.saturating_add(1_000_000_000) < self.last_boot_ns {
            self.reboots += 1;
            self.attitudes.clear();
            sync.reset();
        }
        self.last_boot_ns = boot_ns;
        sync.heard(now_ns, boot_ns);
        sync.mission_ns(now_ns, boot_ns)
    }

    fn keep_attitude(&mut self, stamp_ns: u64, ned_from_frd: DQuat) {
        if self.attitude().is_some_and(|last| last.stamp_ns >= stamp_ns) {
            return;
        }
        self.attitudes.push_back(AttitudeSample { stamp_ns, world_from_body: enu_from_flu(ned_from_frd) });
        while self.attitudes.front().is_some_and(|old| old.stamp_ns + HISTORY_NS < stamp_ns) {
            self.attitudes.pop_front();
        }
    }

    /// Takes a message of the autopilot (component 1) that was received at `now_ns`.
    pub fn take(&mut self, now_ns: u64, message: &MavMessage, world: &mut WorldTransform, sync: &mut TimeSync) {
        self.heard_ns = now_ns;
        match message {
            MavMessage::HEARTBEAT(m) => {
                self.mode = flight_mode(m.custom_mode);
                self.armed = m.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED);
                self.critical = matches!(m.system_status, MavState::MAV_STATE_CRITICAL | MavState::MAV_STATE_EMERGENCY);
                self.heartbeat_ns = now_ns;
                self.heartbeats += 1;
            }
            MavMessage::CURRENT_MODE(m) => {
                self.mode = flight_mode(m.custom_mode);
                self.intended = flight_mode(m.intended_custom_mode);
            }
            MavMessage::ODOMETRY(m) => {
                let position = DVec3::new(f64::from(m.x), f64::from(m.y), f64::from(m.z));
                let Some(attitude) = quaternion(m.q) else { return };
                let velocity = DVec3::new(f64::from(m.vx), f64::from(m.vy), f64::from(m.vz));
                // PX4 sends velocities in the frame that it names; 1 and 20 and 21 are local, the rest are the body's.
                let local = matches!(m.child_frame_id as u32, 1 | 20 | 21);
                let velocity = if local { velocity } else { attitude * velocity };
                if !(sane(position) && sane(velocity)) {
                    return;
                }
                let stamp_ns = self.stamp(now_ns, m.time_usec.saturating_mul(1000), sync);
                self.odometry_ns = now_ns;
                self.keep_attitude(stamp_ns, attitude);
                let rates = DVec3::new(f64::from(m.rollspeed), f64::from(m.pitchspeed), f64::from(m.yawspeed));
                if sane(rates) {
                    self.body_rates_radps = swap_frd_flu(rates);
                }
                self.keep_fix(stamp_ns, position, velocity, Some(m.reset_counter), world);
            }
            // Only where ODOMETRY does not come: this one has no reset counter.
            MavMessage::LOCAL_POSITION_NED(m)
                if now_ns.saturating_sub(self.odometry_ns) > FRESH_NS || self.odometry_ns == 0 =>
            {
                let position = DVec3::new(f64::from(m.x), f64::from(m.y), f64::from(m.z));
                let velocity = DVec3::new(f64::from(m.vx), f64::from(m.vy), f64::from(m.vz));
                if sane(position) && sane(velocity) {
                    let stamp_ns = self.stamp(now_ns, u64::from(m.time_boot_ms) * 1_000_000, sync);
                    self.keep_fix(stamp_ns, position, velocity, None, world);
                }
            }
            MavMessage::ATTITUDE_QUATERNION(m)
                if now_ns.saturating_sub(self.odometry_ns) > FRESH_NS || self.odometry_ns == 0 =>
            {
                if let Some(attitude) = quaternion([m.q1, m.q2, m.q3, m.q4]) {
                    let stamp_ns = self.stamp(now_ns, u64::from(m.time_boot_ms) * 1_000_000, sync);
                    self.keep_attitude(stamp_ns, attitude);
                }
            }
            MavMessage::GPS_GLOBAL_ORIGIN(m) => {
                world.origin(EarthOrigin {
                    latitude_e7: m.latitude,
                    longitude_e7: m.longitude,
                    altitude_mm: m.altitude,
                });
            }
            MavMessage::HOME_POSITION(m) => {
                let local = DVec3::new(f64::from(m.x), f64::from(m.y), f64::from(m.z));
                if sane(local) {
                    self.home = Some((swap_ned_enu(local), f64::from(m.altitude) * 1e-3));
                }
            }
            other => self.take_slow(other),
        }
    }

    fn keep_fix(
        &mut self,
        stamp_ns: u64,
        ned_m: DVec3,
        velocity_ned: DVec3,
        counter: Option<u8>,
        world: &mut WorldTransform,
    ) {
        self.position_m = world.fix(stamp_ns, ned_m, velocity_ned, counter);
        self.velocity_mps = swap_ned_enu(velocity_ned);
        self.position_stamp_ns = stamp_ns;
    }

    fn take_slow(&mut self, message: &MavMessage) {
        match message {
            MavMessage::SYS_STATUS(m) => {
                let has = |sensors: MavSysStatusSensor, bit: u32| sensors.bits() & bit != 0;
                self.armable = has(m.onboard_control_sensors_health, PREARM_BIT);
                self.remote_control =
                    has(m.onboard_control_sensors_present, RC_BIT) && has(m.onboard_control_sensors_health, RC_BIT);
                if self.battery_fraction < 0.0 && m.battery_remaining >= 0 {
                    self.battery_fraction = f64::from(m.battery_remaining.min(100)) / 100.0;
                }
            }
            MavMessage::EXTENDED_SYS_STATE(m) => {
                self.landed = match m.landed_state {
                    MavLandedState::MAV_LANDED_STATE_UNDEFINED => None,
                    state => Some(state == MavLandedState::MAV_LANDED_STATE_ON_GROUND),
                };
            }
            MavMessage::BATTERY_STATUS(m) => {
                if m.battery_remaining >= 0 {
                    self.battery_fraction = f64::from(m.battery_remaining.min(100)) / 100.0;
                }
                self.charge = match m.charge_state as u32 {
                    0 => ChargeState::Unknown,
                    1 => ChargeState::Ok,
                    2 => ChargeState::Low,
                    3 => ChargeState::Critical,
                    _ => ChargeState::Emergency,
                };
            }
            MavMessage::WIND_COV(m) => {
                let wind = DVec3::new(f64::from(m.wind_x), f64::from(m.wind_y), f64::from(m.wind_z));
                if sane(wind) {
                    self.wind_mps = swap_ned_enu(wind);
                }
            }
            MavMessage::AUTOPILOT_VERSION(m) => self.uid = Some(m.uid),
            MavMessage::STATUSTEXT(m) => {
                let text = text_of(m.text.as_ref());
                if m.chunk_seq > 0 {
                    self.text.push_str(&text)
                } else {
                    self.text = text
                }
                self.text.truncate(self.text.char_indices().nth(100).map_or(self.text.len(), |(at, _)| at));
            }
            _ => {}
        }
    }
}

/// Whether a vector can be one of a vehicle: finite, and such as readers of `vehicle/state` believe.
fn sane(vector: DVec3) -> bool {
    vector.abs().max_element() <= FARTHEST && vector.is_finite()
}

/// Text of a fixed field of MAVLink, up to its first zero.
#[must_use]
pub fn text_of(bytes: &[u8]) -> String {
    shared_types::payload::unpack_text(bytes)
}
