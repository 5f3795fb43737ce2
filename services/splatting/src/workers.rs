//! Threads for the stages of a frame, and disjoint mutable access from them.
//!
//! Tasks are handed out by an atomic counter, so a slow tile never idles a core. Nothing may depend on which worker
//! ran a task or when: every task writes places of its own, and sums are taken later in a fixed order. That is what
//! makes results the same bits for any number of threads.

#![expect(unsafe_code, reason = "disjoint parts of one buffer are written by several threads")]

use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use rayon::ThreadPool;

/// A fixed set of worker threads, or none: then the caller's thread does the work.
pub(crate) struct Workers {
    pool: Option<Arc<ThreadPool>>,
}

impl Workers {
    /// `threads` workers; 0 and 1 mean the caller's own thread.
    pub(crate) fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        if threads <= 1 {
            return Ok(Self::sequential());
        }
        let pool =
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("splatting-{i}")).build()?;
        Ok(Self { pool: Some(Arc::new(pool)) })
    }

    /// Everything on the caller's thread.
    pub(crate) fn sequential() -> Self {
        Self { pool: None }
    }

    /// Number of workers.
    pub(crate) fn count(&self) -> usize {
        self.pool.as_ref().map_or(1, |pool| pool.current_num_threads())
    }

    /// The pool, for a caller that has many stages to run: inside of it (`ThreadPool::install`) a worker begins each stage
    /// itself, while a thread outside would have to wake one and be woken again each time.
    pub(crate) fn pool(&self) -> Option<Arc<ThreadPool>> {
        self.pool.clone()
    }

    /// Runs `task(worker, index)` for every index below `tasks`; returns when all are done.
    pub(crate) fn run(&self, tasks: usize, task: impl Fn(usize, usize) + Sync) {
        match &self.pool {
            Some(pool) if tasks > 1 => {
                let next = AtomicUsize::new(0);
                pool.broadcast(|context| {
                    loop {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        if index >= tasks {
                            return;
                        }
                        task(context.index(), index);
                    }
                });
            }
            _ => (0..tasks).for_each(|index| task(0, index)),
        }
    }
}

/// One scratch value per worker.
pub(crate) struct PerWorker<T>(Vec<Mutex<T>>);

impl<T: Default> PerWorker<T> {
    pub(crate) fn new(workers: &Workers) -> Self {
        Self((0..workers.count()).map(|_| Mutex::new(T::default())).collect())
    }

    /// The value of a worker. Never contended: a worker runs one task at a time.
    pub(crate) fn with<R>(&self, worker: usize, f: impl FnOnce(&mut T) -> R) -> R {
        // A poisoned lock means another task panicked; the panic itself travels to the caller through the pool.
        f(&mut self.0[worker].lock().unwrap_or_else(std::sync::PoisonError::into_inner))
    }
}

/// A slice that tasks write in parallel, each its own part.
pub(crate) struct Shared<'a, T> {
    start: *mut T,
    length: usize,
    owner: PhantomData<&'a mut [T]>,
}

// SAFETY: access goes through `slice_mut` and `write`, whose contracts keep parts of concurrent tasks disjoint.
unsafe impl<T: Send> Sync for Shared<'_, T> {}

impl<'a, T> Shared<'a, T> {
    pub(crate) fn new(slice: &'a mut [T]) -> Self {
        Self { start: slice.as_mut_ptr(), length: slice.len(), owner: PhantomData }
    }

    /// The part `range`.
    ///
    /// # Safety
    /// While the returned slice lives, no other part obtained from this value may overlap `range`.
    #[expect(clippy::mut_from_ref, reason = "that is the purpose of the type; the contract is in its Safety section")]
    #[inline(always)]
    pub(crate) unsafe fn slice_mut(&self, range: Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.length, "part {range:?} of {}", self.length);
        // SAFETY: inside the slice by the assertion; exclusive by the caller's promise and the borrow in `owner`.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(range.start), range.end - range.start) }
    }

    /// Writes one element.
    ///
    /// # Safety
    /// No other task may access element `index` while this one runs.
    #[inline(always)]
    pub(crate) unsafe fn write(&self, index: usize, value: T) {
        assert!(index < self.length, "element {index} of {}", self.length);
        // SAFETY: inside the slice by the assertion; exclusive by the caller's promise.
        unsafe { *self.start.add(index) = value }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_runs_once_whatever_the_number_of_workers() {
        for threads in [0, 1, 2, 3] {
            let workers = Workers::new(threads).unwrap();
            let mut done = vec![0_u32; 1000];
            let shared = Shared::new(&mut done);
            workers.run(1000, |worker, i| {
                assert!(worker < workers.count());
                // SAFETY: each index is given to one task.
                unsafe { shared.slice_mut(i..i + 1)[0] += i as u32 + 1 };
            });
            assert!(done.iter().enumerate().all(|(i, &d)| d == i as u32 + 1));
        }
    }
}
