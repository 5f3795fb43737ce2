//! MAV_CMDs: the check of unused parameters, and what each command does and is answered.

use crate::autopilot::CommandResult;
use crate::gimbal::Controller;
use crate::mav::gimbal::GIMBAL_DEVICE_ID;
use crate::mav::inbound::Command;
use crate::modes::Mode;
use crate::streams::Streams;
use crate::vehicle::Vehicle;

const NAV_RETURN_TO_LAUNCH: u16 = 20;
const NAV_LAND: u16 = 21;
const NAV_TAKEOFF: u16 = 22;
const DO_SET_MODE: u16 = 176;
const DO_CHANGE_SPEED: u16 = 178;
const DO_FLIGHTTERMINATION: u16 = 185;
const COMPONENT_ARM_DISARM: u16 = 400;
const GET_MESSAGE_INTERVAL: u16 = 510;
const SET_MESSAGE_INTERVAL: u16 = 511;
const REQUEST_MESSAGE: u16 = 512;
const DO_GIMBAL_MANAGER_PITCHYAW: u16 = 1000;
const DO_GIMBAL_MANAGER_CONFIGURE: u16 = 1001;

/// The number that forces arming and disarming.
const FORCE: f32 = 21196.0;
const CUSTOM_MODE_ENABLED: u32 = 1;

/// Which of the seven parameters each command takes (p1 first); `None` for a command that is not known.
fn used(command: u16) -> Option<[bool; 7]> {
    let takes = |list: &[usize]| core::array::from_fn(|i| list.contains(&(i + 1)));
    Some(match command {
        NAV_RETURN_TO_LAUNCH => takes(&[]),
        NAV_LAND => takes(&[1, 2, 4, 5, 6, 7]),
        NAV_TAKEOFF => takes(&[1, 4, 5, 6, 7]),
        DO_SET_MODE => takes(&[1, 2, 3]),
        DO_CHANGE_SPEED => takes(&[1, 2, 3]),
        DO_FLIGHTTERMINATION => takes(&[1]),
        COMPONENT_ARM_DISARM => takes(&[1, 2]),
        GET_MESSAGE_INTERVAL => takes(&[1]),
        SET_MESSAGE_INTERVAL => takes(&[1, 2, 3, 4, 7]),
        REQUEST_MESSAGE => takes(&[1, 2, 3, 4, 5, 6, 7]),
        DO_GIMBAL_MANAGER_PITCHYAW => takes(&[1, 2, 3, 4, 5, 7]),
        DO_GIMBAL_MANAGER_CONFIGURE => takes(&[1, 2, 3, 4, 7]),
        _ => return None,
    })
}

/// What a command leads to besides its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// The answer.
    pub result: CommandResult,
    /// MESSAGE_INTERVAL of this message is to be sent.
    pub tell_interval_of: Option<u32>,
}

/// Carries out a command of a sender that came over the link with these streams.
pub fn execute(vehicle: &mut Vehicle, streams: &mut Streams, sender: Controller, command: &Command) -> Outcome {
    let mut tell_interval_of = None;
    let result = match used(command.id) {
        None => CommandResult::Unsupported,
        Some(used) if command.params.iter().zip(used).any(|(&p, used)| !used && p.is_finite() && p != 0.0) => {
            CommandResult::Denied
        }
        Some(_) => known(vehicle, streams, sender, command, &mut tell_interval_of),
    };
    Outcome { result, tell_interval_of }
}

fn known(
    vehicle: &mut Vehicle,
    streams: &mut Streams,
    sender: Controller,
    command: &Command,
    tell_interval_of: &mut Option<u32>,
) -> CommandResult {
    let [p1, p2, p3, p4, p5, _, p7] = command.params;
    let now_ns = vehicle.boot_ns();
    match command.id {
        NAV_RETURN_TO_LAUNCH => vehicle.autopilot.choose(Mode::AutoRtl, &vehicle.params),
        NAV_LAND => vehicle.autopilot.choose(Mode::AutoLand, &vehicle.params),
        NAV_TAKEOFF => takeoff(vehicle, f64::from(p7), f64::from(p4)),
        DO_SET_MODE => set_mode(vehicle, p1, p2, p3),
        // Accepted, and without effect on a vehicle that has no mission.
        DO_CHANGE_SPEED => CommandResult::Accepted,
        DO_FLIGHTTERMINATION => {
            if p1 > 0.5 {
                vehicle.autopilot.terminate();
            }
            CommandResult::Accepted
        }
        COMPONENT_ARM_DISARM => match p1.round() as i32 {
            1 => vehicle.autopilot.arm(p2 == FORCE, &vehicle.params),
            0 => vehicle.autopilot.disarm(p2 == FORCE),
            _ => CommandResult::Unsupported,
        },
        GET_MESSAGE_INTERVAL => {
            *tell_interval_of = message_id(p1);
            CommandResult::Accepted
        }
        SET_MESSAGE_INTERVAL => {
            known_message(message_id(p1).is_some_and(|id| streams.set_interval(id, f64::from(p2), now_ns)))
        }
        REQUEST_MESSAGE => {
            let ready = p1 != 242.0 || vehicle.autopilot.home().is_some();
            known_message(ready && message_id(p1).is_some_and(|id| streams.request(id)))
        }
        DO_GIMBAL_MANAGER_CONFIGURE => {
            if !ours(p7) {
                return CommandResult::Denied;
            }
            vehicle.gimbal.configure(sender, (p1, p2), (p3, p4));
            // Who is in control is told at once.
            known_message(streams.request(281))
        }
        DO_GIMBAL_MANAGER_PITCHYAW => {
            let radians = |degrees: f32| f64::from(degrees).to_radians();
            let lock = p5.is_finite() && (p5 as u32) & u32::from(crate::gimbal::flags::YAW_LOCK) != 0;
            let pitch = (radians(p1), radians(p3));
            let yaw = (radians(p2), radians(p4));
            if ours(p7) && vehicle.gimbal.aim(sender, pitch, yaw, lock, &vehicle.params) {
                CommandResult::Accepted
            } else {
                CommandResult::Denied
            }
        }
        _ => CommandResult::Unsupported,
    }
}

fn known_message(known: bool) -> CommandResult {
    if known { CommandResult::Accepted } else { CommandResult::Denied }
}

fn message_id(param: f32) -> Option<u32> {
    (param.is_finite() && (0.0..16_777_216.0).contains(&param)).then_some(param.round() as u32)
}

/// Gimbal device 0 is all of them.
fn ours(device: f32) -> bool {
    !device.is_finite() || device == 0.0 || device == f32::from(GIMBAL_DEVICE_ID)
}

/// p7 is above the sea, not above home.
fn takeoff(vehicle: &mut Vehicle, altitude_amsl_m: f64, yaw_rad: f64) -> CommandResult {
    let Some(home) = vehicle.autopilot.home() else { return CommandResult::TemporarilyRejected };
    let home_amsl_m = f64::from(vehicle.global(home.position_m).2) * 1e-3;
    vehicle.autopilot.takeoff(altitude_amsl_m - home_amsl_m, yaw_rad, &vehicle.params)
}

/// p1 base mode, p2 and p3 PX4's main and sub mode.
fn set_mode(vehicle: &mut Vehicle, base: f32, main: f32, sub: f32) -> CommandResult {
    let number = |p: f32| if p.is_finite() { p.clamp(0.0, 255.0) as u8 } else { 0 };
    if u32::from(number(base)) & CUSTOM_MODE_ENABLED == 0 {
        return CommandResult::TemporarilyRejected;
    }
    match Mode::from_main_sub(number(main), number(sub)) {
        Some(Mode::AutoTakeoff) => takeoff(vehicle, f64::NAN, f64::NAN),
        Some(mode) => vehicle.autopilot.choose(mode, &vehicle.params),
        None => CommandResult::TemporarilyRejected,
    }
}
