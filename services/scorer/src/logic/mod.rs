//! The scorer's logic: no IPC, no clock; images and views come in as arguments.

pub mod score;
