//! The autopilot's parameters: PX4's names and defaults, real or integer, as the parameter protocol carries them.
//!
//! Values travel in one `f32` field; an integer's four bytes are put there unchanged (byte-wise encoding).

/// Type codes of MAV_PARAM_TYPE that PX4 uses.
pub const TYPE_INT32: u8 = 6;
/// A real number in a parameter message.
pub const TYPE_REAL32: u8 = 9;

/// A parameter's value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// INT32.
    Int(i32),
    /// REAL32.
    Real(f32),
}

impl Value {
    /// MAV_PARAM_TYPE code.
    #[must_use]
    pub fn type_code(self) -> u8 {
        match self {
            Self::Int(_) => TYPE_INT32,
            Self::Real(_) => TYPE_REAL32,
        }
    }

    /// The four bytes as the message's `f32`.
    #[must_use]
    pub fn to_wire(self) -> f32 {
        match self {
            Self::Int(v) => f32::from_bits(v.cast_unsigned()),
            Self::Real(v) => v,
        }
    }

    /// Reads a message's `f32` as the type it says; `None` for types that PX4 has no parameter of.
    #[must_use]
    pub fn from_wire(wire: f32, type_code: u8) -> Option<Self> {
        match type_code {
            TYPE_INT32 => Some(Self::Int(wire.to_bits().cast_signed())),
            TYPE_REAL32 => Some(Self::Real(wire)),
            _ => None,
        }
    }
}

/// Why a parameter was not set.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ParamError {
    /// No such name.
    #[error("no parameter {name:?}: names are PX4's, for example MPC_XY_VEL_MAX")]
    Unknown {
        /// The name that was asked for.
        name: String,
    },
    /// Real given for an integer or the other way round.
    #[error("parameter {name} is of type {expected}, got type {found}: send it with its own MAV_PARAM_TYPE")]
    Type {
        /// The parameter.
        name: &'static str,
        /// Its type code.
        expected: u8,
        /// The code that came.
        found: u8,
    },
    /// NaN or infinite.
    #[error("parameter {name} must be finite, got {value}")]
    NotFinite {
        /// The parameter.
        name: &'static str,
        /// The value that came.
        value: f32,
    },
}

macro_rules! params {
    ($($name:ident = $kind:ident($default:literal)),* $(,)?) => {
        /// Every parameter, in the order of its index.
        #[expect(non_camel_case_types, reason = "the names are PX4's own")]
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(usize)]
        pub enum Param { $(
            #[doc = concat!("PX4's `", stringify!($name), "`.")]
            $name
        ),* }

        const TABLE: &[(&str, Value)] = &[ $( (stringify!($name), Value::$kind($default)) ),* ];
    };
}

params! {
    BAT_CRIT_THR = Real(0.07),
    BAT_EMERGEN_THR = Real(0.05),
    BAT_LOW_THR = Real(0.15),
    COM_DISARM_LAND = Real(2.0),
    COM_DISARM_PRFLT = Real(10.0),
    COM_DL_LOSS_T = Int(10),
    COM_FAIL_ACT_T = Real(5.0),
    COM_LOW_BAT_ACT = Int(0),
    COM_OBL_RC_ACT = Int(0),
    COM_OF_LOSS_T = Real(1.0),
    COM_RC_IN_MODE = Int(1),
    COM_RC_LOSS_T = Real(0.5),
    COM_RCL_EXCEPT = Int(0),
    COM_SPOOLUP_TIME = Real(1.0),
    GF_ACTION = Int(2),
    GF_MAX_HOR_DIST = Real(0.0),
    GF_MAX_VER_DIST = Real(0.0),
    MAV_SYS_ID = Int(1),
    MC_YAWRATE_MAX = Real(200.0),
    MC_YAW_P = Real(2.8),
    MIS_TAKEOFF_ALT = Real(2.5),
    MNT_MAX_PITCH = Real(20.0),
    MNT_MIN_PITCH = Real(-90.0),
    MNT_MODE_IN = Int(4),
    MNT_MODE_OUT = Int(0),
    MNT_RANGE_YAW = Real(360.0),
    MPC_ACC_DOWN_MAX = Real(3.0),
    MPC_ACC_HOR = Real(3.0),
    MPC_ACC_HOR_MAX = Real(5.0),
    MPC_ACC_UP_MAX = Real(4.0),
    MPC_JERK_AUTO = Real(4.0),
    MPC_JERK_MAX = Real(8.0),
    MPC_LAND_ALT1 = Real(10.0),
    MPC_LAND_ALT2 = Real(5.0),
    MPC_LAND_ALT3 = Real(1.0),
    MPC_LAND_CRWL = Real(0.3),
    MPC_LAND_SPEED = Real(0.7),
    MPC_THR_HOVER = Real(0.6),
    MPC_TILTMAX_AIR = Real(45.0),
    MPC_TKO_RAMP_T = Real(3.0),
    MPC_TKO_SPEED = Real(1.5),
    MPC_VEL_MANUAL = Real(10.0),
    MPC_XY_CRUISE = Real(5.0),
    MPC_XY_P = Real(0.95),
    MPC_XY_VEL_D_ACC = Real(0.2),
    MPC_XY_VEL_I_ACC = Real(0.4),
    MPC_XY_VEL_MAX = Real(12.0),
    MPC_XY_VEL_P_ACC = Real(1.8),
    MPC_YAWRAUTO_MAX = Real(60.0),
    MPC_Z_P = Real(1.0),
    MPC_Z_VEL_I_ACC = Real(2.0),
    MPC_Z_VEL_MAX_DN = Real(1.5),
    MPC_Z_VEL_MAX_UP = Real(3.0),
    MPC_Z_VEL_P_ACC = Real(4.0),
    MPC_Z_V_AUTO_DN = Real(1.5),
    MPC_Z_V_AUTO_UP = Real(3.0),
    NAV_ACC_RAD = Real(10.0),
    NAV_DLL_ACT = Int(0),
    NAV_MC_ALT_RAD = Real(0.8),
    NAV_RCL_ACT = Int(2),
    RTL_DESCEND_ALT = Real(10.0),
    RTL_LAND_DELAY = Real(0.0),
    RTL_RETURN_ALT = Real(30.0),
    SIM_BAT_DRAIN = Real(1080.0),
    SIM_BAT_MIN_PCT = Real(0.0),
    SYS_AUTOSTART = Int(4001),
}

/// The values of one vehicle.
#[derive(Debug, Clone)]
pub struct Params {
    values: Vec<Value>,
}

impl Default for Params {
    fn default() -> Self {
        Self { values: TABLE.iter().map(|&(_, value)| value).collect() }
    }
}

impl Params {
    /// How many there are.
    #[must_use]
    pub fn count() -> usize {
        TABLE.len()
    }

    /// Name of an index.
    #[must_use]
    pub fn name(index: usize) -> Option<&'static str> {
        TABLE.get(index).map(|&(name, _)| name)
    }

    /// Index of a name.
    #[must_use]
    pub fn index_of(name: &str) -> Option<usize> {
        TABLE.iter().position(|&(known, _)| known == name)
    }

    /// Value at an index.
    #[must_use]
    pub fn at(&self, index: usize) -> Option<Value> {
        self.values.get(index).copied()
    }

    /// Value as a number, whatever its type.
    #[must_use]
    pub fn real(&self, param: Param) -> f64 {
        match self.at(param as usize) {
            Some(Value::Real(v)) => f64::from(v),
            Some(Value::Int(v)) => f64::from(v),
            None => 0.0,
        }
    }

    /// A degrees parameter in radians.
    #[must_use]
    pub fn radians(&self, param: Param) -> f64 {
        self.real(param).to_radians()
    }

    /// Value as an integer; a real is rounded.
    #[must_use]
    pub fn int(&self, param: Param) -> i32 {
        match self.at(param as usize) {
            Some(Value::Int(v)) => v,
            Some(Value::Real(v)) => v.round() as i32,
            None => 0,
        }
    }

    /// Sets a parameter by name, of its own type only.
    ///
    /// # Errors
    /// Unknown name, other type, or a value that is not finite; nothing is changed then.
    pub fn set(&mut self, name: &str, value: Value) -> Result<usize, ParamError> {
        let index = Self::index_of(name).ok_or_else(|| ParamError::Unknown { name: name.to_owned() })?;
        let known = Self::name(index).unwrap_or("");
        let slot = self.values.get_mut(index).ok_or_else(|| ParamError::Unknown { name: name.to_owned() })?;
        if slot.type_code() != value.type_code() {
            return Err(ParamError::Type { name: known, expected: slot.type_code(), found: value.type_code() });
        }
        if let Value::Real(v) = value
            && !v.is_finite()
        {
            return Err(ParamError::NotFinite { name: known, value: v });
        }
        *slot = value;
        Ok(index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_fit_the_wire() {
        for (index, (name, _)) in TABLE.iter().enumerate() {
            assert_eq!(Params::index_of(name), Some(index), "{name} twice");
        }
        assert!(TABLE.iter().all(|(name, _)| name.len() <= 16));
        assert_eq!(Params::index_of("MPC_XY_P"), Some(Param::MPC_XY_P as usize));
    }

    #[test]
    fn a_value_of_another_type_or_not_finite_changes_nothing() {
        let mut params = Params::default();
        assert!(matches!(params.set("MPC_XY_P", Value::Int(1)), Err(ParamError::Type { .. })));
        assert!(matches!(params.set("MPC_XY_P", Value::Real(f32::NAN)), Err(ParamError::NotFinite { .. })));
        assert!(matches!(params.set("NO_SUCH", Value::Int(1)), Err(ParamError::Unknown { .. })));
        assert!((params.real(Param::MPC_XY_P) - 0.95).abs() < 1e-6);
        assert!(params.set("COM_OBL_RC_ACT", Value::Int(5)).is_ok());
        assert_eq!(params.int(Param::COM_OBL_RC_ACT), 5);
    }

    proptest::proptest! {
        #[test]
        fn integers_and_reals_survive_the_wire(int in proptest::num::i32::ANY, real in proptest::num::f32::NORMAL) {
            // An integer's bytes may spell a NaN; its bits must come through all the same.
            let wire = Value::Int(int).to_wire();
            proptest::prop_assert_eq!(Value::from_wire(f32::from_le_bytes(wire.to_le_bytes()), TYPE_INT32), Some(Value::Int(int)));
            proptest::prop_assert_eq!(Value::from_wire(Value::Real(real).to_wire(), TYPE_REAL32), Some(Value::Real(real)));
        }
    }
}
