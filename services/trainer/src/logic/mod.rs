//! The trainer's logic: no IPC, no clock, no files; time, seeds and images come in as arguments. What offline training does
//! too (pixel classes, insertion, pruning) is in `splatting::rgbd`.

pub mod rounds;
