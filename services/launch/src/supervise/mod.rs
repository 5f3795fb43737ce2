//! The supervisor: starts the services, watches them, starts the dead again, stops them in order.
//!
//! [`machine`] decides and knows no process and no clock; [`children`] are the processes; [`ports`] is all its IPC;
//! [`run`] is the loop that ties them together.

mod autopsy;
pub mod children;
pub mod machine;
pub mod memory;
pub mod plan;
pub mod ports;
pub mod run;
pub mod track;

pub use machine::Outcome;
pub use run::{Flight, run};
