//! The vehicle: its state, the path it is told to fly, and the commands it takes.

use crate::{codes, payload};

payload! {
    /// `vehicle/state`: what px4-link knows of the vehicle. World is ENU; body is FLU (x forward, y left, z up).
    ///
    /// The envelope's `stamp_ns` is `position_stamp_ns`. Vectors of a part that was never received are zero with a stamp of 0.
    pub struct VehicleState [376] {
        /// Which life of px4-link wrote this; differs after a restart.
        pub incarnation: u64,
        /// Mission time of `position_m` and `velocity_mps`.
        pub position_stamp_ns: u64,
        /// Mission time of `world_from_body_xyzw` and `body_rates_radps`.
        pub attitude_stamp_ns: u64,
        /// Mission time of `world_from_gimbal_xyzw`.
        pub gimbal_stamp_ns: u64,
        /// One standard deviation of those stamps (clock synchronisation), nanoseconds.
        pub time_uncertainty_ns: u64,
        /// Mission time since the last datagram from the autopilot.
        pub link_age_ns: u64,
        /// Id of the target being flown; 0 when none is.
        pub target_id: u64,
        /// Position of the body's origin in the world, metres.
        pub position_m: [f64; 3],
        /// Velocity in the world, m/s.
        pub velocity_mps: [f64; 3],
        /// Attitude of the body (FLU) in the world (ENU).
        pub world_from_body_xyzw: [f64; 4],
        /// Angular rates about the body's axes (FLU), rad/s.
        pub body_rates_radps: [f64; 3],
        /// Attitude of the gimbal's payload frame (FLU: x along the optical axis) in the world.
        pub world_from_gimbal_xyzw: [f64; 4],
        /// Angular rate of the gimbal's payload in the world, rad/s, from successive attitudes.
        pub gimbal_rates_radps: [f64; 3],
        /// Lowest pitch the gimbal reports, radians; negative looks down.
        pub gimbal_pitch_min_rad: f64,
        /// Highest pitch the gimbal reports, radians.
        pub gimbal_pitch_max_rad: f64,
        /// Where the setpoint generator is now, metres: what a new target must start from.
        pub setpoint_position_m: [f64; 3],
        /// Yaw of the setpoint (ENU, from east, counter-clockwise), radians.
        pub setpoint_yaw_rad: f64,
        /// Home in the world, metres.
        pub home_m: [f64; 3],
        /// Wind in the world, m/s; zero when the autopilot does not say.
        pub wind_mps: [f64; 3],
        /// Charge left, 0..1.
        pub battery_fraction: f64,
        /// Length flown along the target's path, 0..1.
        pub target_progress: f64,
        /// [`ChargeState`] code.
        pub charge_state: u32,
        /// [`FlightMode`] code.
        pub mode: u32,
        /// 1 when armed.
        pub armed: u32,
        /// 1 on the ground, 0 in the air.
        pub landed: u32,
        /// [`FailsafeReason`] code; `None` when no failsafe acts.
        pub failsafe: u32,
        /// [`Commander`] code: who flies the vehicle.
        pub commander: u32,
        /// [`TargetStatus`] code of `target_id`.
        pub target_status: u32,
        /// How often the estimator's origin moved and was compensated.
        pub reset_count: u32,
        /// 1 once position, attitude and home are known and fresh.
        pub ready: u32,
        /// 1 when the autopilot reports that it can arm.
        pub armable: u32,
        /// 1 when a gimbal answered.
        pub gimbal_present: u32,
        /// 1 when setpoints are being streamed.
        pub streaming: u32,
    }
}

codes! {
    /// The autopilot's mode, as far as Vantage tells them apart.
    pub enum FlightMode {
        /// Not heard yet.
        Unknown = 0, "unknown",
        /// A mode in which a pilot's sticks fly (manual, altitude, position, acro, stabilised).
        Pilot = 1, "pilot",
        /// AUTO.TAKEOFF.
        Takeoff = 2, "takeoff",
        /// AUTO.LOITER.
        Hold = 3, "hold",
        /// AUTO.RTL.
        Return = 4, "return",
        /// AUTO.LAND.
        Land = 5, "land",
        /// OFFBOARD.
        Offboard = 6, "offboard",
        /// Any other autonomous mode (mission, follow me).
        Other = 7, "other",
    }
}

codes! {
    /// Who flies the vehicle.
    pub enum Commander {
        /// Nobody: on the ground, disarmed.
        Nobody = 0, "nobody",
        /// Vantage, through OFFBOARD or a command of its own (takeoff, hold, return, land).
        Vantage = 1, "vantage",
        /// A pilot or another ground station chose the mode.
        Pilot = 2, "pilot",
        /// A failsafe of the autopilot.
        Failsafe = 3, "failsafe",
    }
}

codes! {
    /// Why a failsafe acts.
    pub enum FailsafeReason {
        /// None acts.
        None = 0, "none",
        /// The stream of setpoints stopped.
        OffboardLost = 1, "offboard-lost",
        /// The ground station's link is gone.
        LinkLost = 2, "link-lost",
        /// The battery is low, critical or empty.
        Battery = 3, "battery",
        /// The geofence was crossed.
        Geofence = 4, "geofence",
        /// Another, or the autopilot does not say.
        Other = 5, "other",
    }
}

codes! {
    /// What the battery says of itself.
    pub enum ChargeState {
        /// Not heard.
        Unknown = 0, "unknown",
        /// Enough.
        Ok = 1, "ok",
        /// A warning.
        Low = 2, "low",
        /// Return now.
        Critical = 3, "critical",
        /// Land now.
        Emergency = 4, "emergency",
    }
}

codes! {
    /// What became of a target.
    pub enum TargetStatus {
        /// There is none.
        None = 0, "none",
        /// Being flown.
        Flying = 1, "flying",
        /// At its end: the setpoint stands there and the vehicle is within tolerance.
        Arrived = 2, "arrived",
        /// Refused: the id was seen before.
        RefusedOld = 3, "refused-old",
        /// Refused: the path starts more than 0.3 m from the present setpoint.
        RefusedStart = 4, "refused-start",
        /// Refused: a point outside the mission volume, not finite, or too many points.
        RefusedPath = 5, "refused-path",
        /// Braked and held: `planner/alive` is too old.
        Held = 6, "held",
    }
}

payload! {
    /// `vehicle/target`: a path to fly. The items are `path_len` waypoints of the path, then `return_len` waypoints of the
    /// checked way back from its end to above the landing point.
    pub struct VehicleTarget [72] {
        /// Increases with every target of a mission; never used twice in it.
        pub id: u64,
        /// [`super::mission::mission_key`] of the mission that the id counts in.
        pub mission: u64,
        /// Lowest corner of the volume that no setpoint leaves, metres.
        pub volume_min_m: [f64; 3],
        /// Highest corner of that volume, metres.
        pub volume_max_m: [f64; 3],
        /// Number of waypoints to fly; the first is where the setpoint is now.
        pub path_len: u32,
        /// Number of waypoints of the way back.
        pub return_len: u32,
    }
}

payload! {
    /// One point of a path.
    pub struct Waypoint [48] {
        /// In the world, metres.
        pub position_m: [f64; 3],
        /// Yaw at this point (ENU: from east, counter-clockwise), radians; interpolated along the leg.
        pub yaw_rad: f64,
        /// Gimbal pitch at this point, radians, negative down.
        pub gimbal_pitch_rad: f64,
        /// Highest speed on the leg that ends here, m/s.
        pub speed_mps: f64,
    }
}

codes! {
    /// What the vehicle can be told besides paths.
    pub enum VehicleCommand {
        /// Stream the present pose and enter OFFBOARD.
        TakeControl = 1, "take-control",
        /// Arm the motors.
        Arm = 2, "arm",
        /// Take off to `altitude_m` above home.
        Takeoff = 3, "takeoff",
        /// Stop and stay.
        Hold = 4, "hold",
        /// Fly the stored return path, or the autopilot's own return, then land.
        Return = 5, "return",
        /// Land here.
        Land = 6, "land",
        /// The operator's word that Vantage may command again after a pilot or a failsafe.
        GoOn = 7, "go-on",
        /// The world lies elsewhere than the estimator's origin says: add `shift_m` to the transform. In the air the vehicle
        /// holds for it, and has to be taken control of again.
        ShiftWorld = 8, "shift-world",
    }
}

payload! {
    /// Request of `vehicle/command`.
    pub struct CommandRequest [40] {
        /// [`VehicleCommand`] code.
        pub command: u32,
        /// For `ShiftWorld`, [`VehicleState::reset_count`] as it was when the shift was measured; refused where it is another
        /// by now.
        pub reset_count: u32,
        /// Height above home for `Takeoff`, metres.
        pub altitude_m: f64,
        /// For `ShiftWorld`, what to add to positions in the world, metres.
        pub shift_m: [f64; 3],
    }
}

codes! {
    /// How far a command is.
    pub enum CommandStatus {
        /// Taken, being worked on.
        Accepted = 1, "accepted",
        /// Done, and seen in the vehicle's state.
        Confirmed = 2, "confirmed",
        /// Not done; the reason says why.
        Refused = 3, "refused",
        /// Sent before px4-link's present life began: not acted on. Look at the state and ask with a new id.
        Restarted = 4, "restarted",
    }
}

payload! {
    /// Reply of `vehicle/command`; `Accepted` may be followed by another reply to the same request.
    pub struct CommandReply [128] {
        /// [`CommandStatus`] code.
        pub status: u32,
        /// [`VehicleCommand`] code of the request.
        pub command: u32,
        /// Why it was refused; text, see [`crate::payload::unpack_text`].
        pub reason: [u8; 120],
    }
}

payload! {
    /// `planner/alive`: the planner's loop turns.
    pub struct Alive [8] {
        /// Counts the turns of the work loop.
        pub sequence: u64,
    }
}
