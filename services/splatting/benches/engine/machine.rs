//! What this machine can do at best: its name, its peak of fused multiply-adds, its memory bandwidth.

#![cfg_attr(
    target_arch = "x86_64",
    expect(unsafe_code, reason = "the peak of an instruction set needs its instructions")
)]

use std::hint::black_box;
use std::sync::Barrier;
use std::thread;
use std::time::Instant;

/// Measured limits of the machine.
pub struct Machine {
    /// Name of the processor.
    pub cpu: String,
    /// Peak of one core, single precision.
    pub fma_gflops_per_core: f64,
    /// All threads together, reading two streams and writing one.
    pub bandwidth_gb_s: f64,
}

/// Limits of the machine on which the figures to reach were set: two Sapphire Rapids cores, 20 GB/s each.
pub const REFERENCE: Machine = Machine { cpu: String::new(), fma_gflops_per_core: 145.0, bandwidth_gb_s: 40.0 };

impl Machine {
    /// The same with as many of its cores as this.
    pub fn with_cores(&self, cores: usize) -> Self {
        Self { cpu: self.cpu.clone(), bandwidth_gb_s: self.bandwidth_gb_s * cores as f64 / 2.0, ..*self }
    }

    /// Measures for about two seconds. The best of many short attempts counts, since other processes share the cores.
    pub fn measure(threads: usize) -> Self {
        let best = (0..200).map(|_| fma_gflops()).fold(0.0, f64::max);
        Self { cpu: cpu_name(), fma_gflops_per_core: best, bandwidth_gb_s: bandwidth(threads) }
    }
}

fn cpu_name() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        text.lines().find(|l| l.starts_with(name)).and_then(|l| l.split_once(':')).map(|(_, v)| v.trim().to_owned())
    };
    let name = field("model name").unwrap_or_else(|| std::env::consts::ARCH.to_owned());
    match (field("cpu family"), field("model\t")) {
        (Some(family), Some(model)) => format!("{name} (family {family}, model {model})"),
        _ => name,
    }
}

const ROUNDS: usize = 100_000;
/// Independent chains, enough to cover the latency of an instruction.
const CHAINS: usize = 12;

#[cfg(target_arch = "x86_64")]
fn fma_gflops() -> f64 {
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx512f")]
    fn wide() -> f32 {
        let (a, b) = (_mm512_set1_ps(black_box(0.999)), _mm512_set1_ps(black_box(0.001)));
        let mut chains = [b; CHAINS];
        for _ in 0..ROUNDS {
            for chain in &mut chains {
                *chain = _mm512_fmadd_ps(*chain, a, b);
            }
        }
        chains.iter().map(|&c| _mm512_reduce_add_ps(c)).sum()
    }
    #[target_feature(enable = "avx2,fma")]
    fn narrow() -> f32 {
        let (a, b) = (_mm256_set1_ps(black_box(0.999)), _mm256_set1_ps(black_box(0.001)));
        let mut chains = [b; CHAINS];
        for _ in 0..ROUNDS {
            for chain in &mut chains {
                *chain = _mm256_fmadd_ps(*chain, a, b);
            }
        }
        chains.iter().map(|&c| _mm256_cvtss_f32(c)).sum()
    }

    let start = Instant::now();
    let lanes = if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature was just detected.
        black_box(unsafe { wide() });
        16
    } else if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: the features were just detected.
        black_box(unsafe { narrow() });
        8
    } else {
        return plain_gflops();
    };
    (2 * lanes * CHAINS * ROUNDS) as f64 / start.elapsed().as_secs_f64() / 1e9
}

#[cfg(not(target_arch = "x86_64"))]
fn fma_gflops() -> f64 {
    plain_gflops()
}

/// What the compiler makes of plain Rust.
fn plain_gflops() -> f64 {
    let start = Instant::now();
    let (a, b) = (black_box(0.999_f32), black_box(0.001_f32));
    let mut chains = [[b; 4]; CHAINS];
    for _ in 0..ROUNDS {
        for chain in &mut chains {
            for lane in chain {
                *lane = *lane * a + b;
            }
        }
    }
    black_box(chains);
    (2 * 4 * CHAINS * ROUNDS) as f64 / start.elapsed().as_secs_f64() / 1e9
}

/// Gigabytes per second of a = b + c over arrays far larger than any cache.
fn bandwidth(threads: usize) -> f64 {
    const LENGTH: usize = 8 << 20;
    const ATTEMPTS: usize = 8;
    let barrier = Barrier::new(threads);
    let seconds: Vec<f64> = thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|_| {
                scope.spawn(|| {
                    let (mut a, b, c) = (vec![0.0_f32; LENGTH], vec![1.0_f32; LENGTH], vec![2.0_f32; LENGTH]);
                    let attempt = || {
                        barrier.wait();
                        let start = Instant::now();
                        for ((a, b), c) in a.iter_mut().zip(&b).zip(&c) {
                            *a = b + c;
                        }
                        black_box(&mut a);
                        start.elapsed().as_secs_f64()
                    };
                    std::iter::repeat_with(attempt).take(ATTEMPTS).fold(f64::INFINITY, f64::min)
                })
            })
            .collect();
        workers.into_iter().filter_map(|w| w.join().ok()).collect()
    });
    seconds.iter().map(|s| 12.0 * LENGTH as f64 / s / 1e9).sum()
}
