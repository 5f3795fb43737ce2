//! Pure logic: no IPC, no clock, no global random source. Time and seeds come in as arguments.

pub mod align;
pub mod candidates;
pub mod cost;
pub mod coverage;
pub mod depth;
pub mod occupancy;
pub mod orbit;
pub mod path;
pub mod prior;
pub mod selection;
pub mod space;
pub mod view;
