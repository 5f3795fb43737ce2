//! What a thread with a deadline asks of the kernel: that its memory stays where it is.

use core::ffi::c_void;

/// How much of the calling thread's stack is locked, below the caller's frame.
pub const STACK_BYTES: usize = 192 * 1024;

/// Keeps a value's own bytes (not what it points to) in memory. The lock ends with the process or when the page is unmapped.
///
/// # Errors
/// What the kernel says: usually that the limit of locked memory (`ulimit -l`) is too small.
pub fn lock_value<T: ?Sized>(value: &T) -> Result<(), rustix::io::Errno> {
    lock(core::ptr::from_ref(value).cast::<u8>().cast_mut(), size_of_val(value))
}

/// Touches and keeps the calling thread's stack in memory, [`STACK_BYTES`] down from here. The thread's stack must be
/// larger than that: start it with at least twice as much.
///
/// # Errors
/// As [`lock_value`].
#[inline(never)]
pub fn lock_stack() -> Result<(), rustix::io::Errno> {
    // The frame of this function is that part of the stack; zeroing touches its pages.
    let below = [0u8; STACK_BYTES];
    lock_value(core::hint::black_box(&below))
}

#[expect(unsafe_code, reason = "locking memory takes a raw range")]
fn lock(start: *mut u8, len: usize) -> Result<(), rustix::io::Errno> {
    if len == 0 {
        return Ok(());
    }
    // SAFETY: both callers pass the range of a live reference, so it is mapped; mlock changes no byte of it, only that its
    // pages stay resident, and the kernel rounds the range to pages itself.
    unsafe { rustix::mm::mlock(start.cast::<c_void>(), len) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stack_and_a_value_are_locked_or_refused_by_the_limit() {
        let refused = [rustix::io::Errno::NOMEM, rustix::io::Errno::PERM, rustix::io::Errno::AGAIN];
        for result in [lock_stack(), lock_value(&[7u8; 100]), lock_value::<[u8]>(&[])] {
            assert!(result.is_ok() || result.is_err_and(|error| refused.contains(&error)), "{result:?}");
        }
        assert_eq!(lock_value::<[u8]>(&[]), Ok(()));
    }
}
