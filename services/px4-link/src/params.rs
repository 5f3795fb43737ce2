//! The autopilot's parameters that decide whether it is safe to fly, and what to say about them.

use std::collections::BTreeMap;

use mavlink::dialects::common::{MavMessage, MavParamType, PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, PARAM_VALUE_DATA};

use crate::telemetry::text_of;

/// What is read at the start of every connection.
pub const READ: [&str; 11] = [
    "COM_OBL_RC_ACT",
    "COM_OF_LOSS_T",
    "COM_LOW_BAT_ACT",
    "NAV_DLL_ACT",
    "COM_RC_IN_MODE",
    "COM_RCL_EXCEPT",
    "GF_ACTION",
    "GF_MAX_HOR_DIST",
    "GF_MAX_VER_DIST",
    "MPC_XY_VEL_MAX",
    "MPC_Z_VEL_MAX_UP",
];

/// What is set where `link.set_params` allows: hold when setpoints stop; return, then land, as the battery empties.
pub const WANTED: [(&str, i32); 2] = [("COM_OBL_RC_ACT", 5), ("COM_LOW_BAT_ACT", 3)];

/// A parameter's value. Integers travel as their bits in a float.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// INT32 and shorter.
    Int(i32),
    /// REAL32.
    Real(f32),
}

impl Value {
    /// As a number.
    #[must_use]
    pub fn number(self) -> f64 {
        match self {
            Self::Int(value) => f64::from(value),
            Self::Real(value) => f64::from(value),
        }
    }
}

/// Reads an answer.
#[must_use]
pub fn read(message: &PARAM_VALUE_DATA) -> (String, Value) {
    let value = match message.param_type {
        MavParamType::MAV_PARAM_TYPE_REAL32 => Value::Real(message.param_value),
        #[expect(clippy::cast_possible_wrap, reason = "the bits are those of an INT32")]
        _ => Value::Int(message.param_value.to_bits() as i32),
    };
    (text_of(message.param_id.as_ref()), value)
}

/// Asks for a parameter.
#[must_use]
pub fn request(system: u8, name: &str) -> MavMessage {
    MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
        target_system: system,
        target_component: 1,
        param_id: name.into(),
        param_index: -1,
    })
}

/// Sets an integer parameter; the answer is its new value.
#[must_use]
pub fn set(system: u8, name: &str, value: i32) -> MavMessage {
    MavMessage::PARAM_SET(PARAM_SET_DATA {
        target_system: system,
        target_component: 1,
        param_id: name.into(),
        #[expect(clippy::cast_sign_loss, reason = "the bits of an INT32 in a float")]
        param_value: f32::from_bits(value as u32),
        param_type: MavParamType::MAV_PARAM_TYPE_INT32,
    })
}

/// The parameters as far as they were heard.
pub type Params = BTreeMap<String, Value>;

/// Why it is not safe to fly, with the way out; `None` when nothing speaks against it.
#[must_use]
pub fn refusal(params: &Params, remote_control: bool, allowed: bool) -> Option<String> {
    let Some(action) = params.get("COM_OBL_RC_ACT").map(|value| value.number()) else {
        // Not known is not safe: its default climbs and returns.
        return (!allowed).then(|| {
            "COM_OBL_RC_ACT did not answer; expected 5 (hold when setpoints stop): check that parameters can be read, or set link.allow_unsafe_offboard_loss = true".to_owned()
        });
    };
    let needs_sticks = (0.0..=2.0).contains(&action);
    (needs_sticks && !remote_control && !allowed).then(|| {
        format!(
            "COM_OBL_RC_ACT is {action} without a remote control; expected 5 (hold): set it, or link.set_params = true"
        )
    })
}

/// Bit of COM_RCL_EXCEPT: OFFBOARD goes on without a remote control.
const EXCEPT_OFFBOARD: i32 = 4;

/// Advice on parameters that are legal and unwise.
#[must_use]
pub fn advice(params: &Params, remote_control: bool, speed_mps: f64) -> Vec<String> {
    let mut advice = Vec::new();
    let number = |name: &str| params.get(name).map(|value| value.number());
    let except = params.get("COM_RCL_EXCEPT").copied();
    let excepted = matches!(except, Some(Value::Int(bits)) if bits & EXCEPT_OFFBOARD != 0);
    let mut unless = |name: &str, fits: &dyn Fn(f64) -> bool, text: &str| match number(name) {
        Some(value) if fits(value) => {}
        Some(value) => advice.push(format!("{name} is {value}; {text}")),
        None => advice.push(format!("{name} did not answer; {text}")),
    };
    unless("COM_OBL_RC_ACT", &|v| v == 5.0, "5 holds when setpoints stop");
    unless("COM_OF_LOSS_T", &|v| (0.5..=5.0).contains(&v), "1.0 s lets px4-link restart before a failsafe");
    unless("COM_LOW_BAT_ACT", &|v| v >= 2.0, "3 returns at a critical and lands at an empty battery");
    unless("NAV_DLL_ACT", &|v| v == 0.0, "another value refuses to arm without a ground station (link.gcs_heartbeat)");
    unless(
        "COM_RC_IN_MODE",
        &|v| remote_control || excepted || v == 4.0,
        "without a remote control its loss ends OFFBOARD: 4 expects none, or set bit 2 (4) of COM_RCL_EXCEPT",
    );
    if except.is_none() {
        unless("COM_RCL_EXCEPT", &|_| true, "bit 2 (4) lets OFFBOARD go on without a remote control");
    }
    unless("GF_MAX_HOR_DIST", &|v| v > 0.0, "a distance from home keeps a lost vehicle near");
    unless("GF_MAX_VER_DIST", &|v| v > 0.0, "a height above home keeps a lost vehicle low");
    unless("GF_ACTION", &|v| [2.0, 3.0, 5.0].contains(&v), "2 holds, 3 returns, 5 lands at the fence; 0 and 1 fly on");
    unless(
        "MPC_XY_VEL_MAX",
        &|v| (speed_mps..=4.0 * speed_mps).contains(&v),
        "from link.speed_mps, below which the vehicle lags behind, to four times that, which bounds what a wrong setpoint does",
    );
    unless("MPC_Z_VEL_MAX_UP", &|v| v >= 1.0, "less than 1 m/s makes climbs lag behind their setpoints");
    advice
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_travel_as_bits() {
        let MavMessage::PARAM_SET(sent) = set(1, "COM_OBL_RC_ACT", 5) else { panic!("a PARAM_SET") };
        let answer = PARAM_VALUE_DATA {
            param_value: sent.param_value,
            param_id: sent.param_id,
            param_type: sent.param_type,
            ..Default::default()
        };
        assert_eq!(read(&answer), ("COM_OBL_RC_ACT".to_owned(), Value::Int(5)));
    }

    #[test]
    fn a_default_autopilot_without_remote_control_is_refused_with_the_way_out() {
        let with = |value| Params::from([("COM_OBL_RC_ACT".to_owned(), Value::Int(value))]);
        assert!(refusal(&with(0), false, false).is_some_and(|text| text.contains("link.set_params")));
        assert_eq!(refusal(&with(0), true, false), None);
        assert_eq!(refusal(&with(0), false, true), None);
        assert_eq!(refusal(&with(5), false, false), None);
        assert!(refusal(&Params::new(), false, false).is_some_and(|text| text.contains("did not answer")));
        assert_eq!(refusal(&Params::new(), false, true), None);
    }

    #[test]
    fn advice_names_every_parameter_that_is_unwise_or_silent() {
        let wise = [
            ("COM_OBL_RC_ACT", 5),
            ("COM_OF_LOSS_T", 1),
            ("COM_LOW_BAT_ACT", 3),
            ("NAV_DLL_ACT", 0),
            ("COM_RC_IN_MODE", 3),
            ("COM_RCL_EXCEPT", 4),
            ("GF_ACTION", 2),
            ("GF_MAX_HOR_DIST", 50),
            ("GF_MAX_VER_DIST", 30),
            ("MPC_XY_VEL_MAX", 4),
            ("MPC_Z_VEL_MAX_UP", 3),
        ];
        let with = |other: &[(&str, i32)]| -> Params {
            wise.iter().chain(other).map(|&(name, value)| (name.to_owned(), Value::Int(value))).collect()
        };
        assert_eq!(advice(&with(&[]), false, 2.0), Vec::<String>::new());
        for (name, value) in [
            ("COM_OBL_RC_ACT", 0),
            ("GF_ACTION", 1),
            ("GF_MAX_VER_DIST", 0),
            ("MPC_XY_VEL_MAX", 12),
            ("MPC_XY_VEL_MAX", 1),
        ] {
            let lines = advice(&with(&[(name, value)]), false, 2.0);
            assert!(lines.len() == 1 && lines[0].starts_with(name), "{lines:?}");
        }
        // Without a remote control, and with one.
        assert_eq!(advice(&with(&[("COM_RCL_EXCEPT", 2)]), false, 2.0).len(), 1);
        assert_eq!(advice(&with(&[("COM_RCL_EXCEPT", 2)]), true, 2.0).len(), 0);
        assert_eq!(advice(&Params::new(), false, 2.0).len(), READ.len());
    }
}
