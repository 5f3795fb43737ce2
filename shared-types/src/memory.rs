//! How a service's allocator treats memory that was freed.

/// Blocks from this size on get pages of their own, which go back to the kernel when they are freed, bytes.
#[cfg(target_env = "gnu")]
const OWN_PAGES_BYTES: i32 = 1 << 20;
/// Free memory at the heap's end that goes back to the kernel, bytes.
#[cfg(target_env = "gnu")]
const TRIM_BYTES: i32 = 4 << 20;

/// Makes freed memory leave the process. Left to itself, glibc raises the size from which blocks get pages of their own to
/// that of the largest block freed so far: checkpoints and snapshots of a growing model, each a little larger than the
/// last, then leave holes that nothing fits into (a trainer of 120,000 Gaussians held 311 MB; with this, 138 MB).
///
/// Call it once, before threads are started. Does nothing with another C library.
pub fn give_back_freed_memory() {
    #[cfg(target_env = "gnu")]
    {
        let fixed = set(libc::M_MMAP_THRESHOLD, OWN_PAGES_BYTES) && set(libc::M_TRIM_THRESHOLD, TRIM_BYTES);
        if !fixed {
            tracing::debug!("the allocator keeps its thresholds");
        }
    }
}

#[cfg(target_env = "gnu")]
#[expect(unsafe_code, reason = "the C library's allocator is set by a C call")]
fn set(parameter: i32, value: i32) -> bool {
    // SAFETY: mallopt takes two integers, changes only the allocator's own settings, and takes its lock itself.
    unsafe { libc::mallopt(parameter, value) == 1 }
}

#[cfg(all(test, target_env = "gnu"))]
mod tests {
    use super::*;

    #[test]
    fn the_thresholds_are_taken() {
        assert!(set(libc::M_MMAP_THRESHOLD, OWN_PAGES_BYTES) && set(libc::M_TRIM_THRESHOLD, TRIM_BYTES));
    }
}
