//! Bytes on the GPU, by name.

use std::collections::BTreeMap;

use wgpu::Buffer;

/// How many bytes are allocated for what.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Bytes(BTreeMap<&'static str, u64>);

impl Bytes {
    pub fn add(&mut self, what: &'static str, buffer: &Buffer) {
        *self.0.entry(what).or_default() += buffer.size();
    }

    pub fn into_list(self) -> Vec<(&'static str, u64)> {
        self.0.into_iter().collect()
    }
}
