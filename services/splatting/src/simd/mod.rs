//! Sixteen-wide f32 arithmetic over `std::arch`, chosen at run time.
//!
//! Kernels are written once, generic over [`Simd`], and entered through [`dispatch`], which compiles each of them for
//! AVX-512, for AVX2 with FMA, for NEON (on 64-bit ARM) and for plain Rust. Stable Rust, no `target-cpu` flags: a binary built anywhere uses what
//! the machine it runs on has. A value of an implementation is the proof that its instructions exist, so calling a
//! method is safe.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod portable;

#[cfg(target_arch = "x86_64")]
use {avx2::Avx2, avx512::Avx512};

use portable::Portable;

/// Instruction set of the engine's kernels. Results differ between sets in the last bits, never within one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// AVX-512 F, DQ and VL: one register per 16 lanes.
    Avx512,
    /// AVX2 and FMA: two registers per 16 lanes.
    Avx2,
    /// NEON: four registers per 16 lanes.
    Neon,
    /// Plain Rust, for every other machine: correct, and many times slower.
    Portable,
}

impl Isa {
    /// Every set, the widest first.
    pub const ALL: [Self; 4] = [Self::Avx512, Self::Avx2, Self::Neon, Self::Portable];

    /// The widest set this machine has.
    pub fn detect() -> Self {
        Self::ALL.into_iter().find(|isa| isa.is_available()).unwrap_or(Self::Portable)
    }

    /// Whether this machine can run the set.
    pub fn is_available(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => Avx512::detect().is_some(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => Avx2::detect().is_some(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx512 | Self::Avx2 => false,
            Self::Neon => cfg!(target_arch = "aarch64"),
            Self::Portable => true,
        }
    }
}

/// A computation generic over the instruction set. `run` must be `#[inline(always)]`, with everything it calls.
pub(crate) trait Kernel {
    type Output;
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

/// Runs a kernel with an instruction set; falls back to plain Rust where the machine lacks it.
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Output {
    match isa {
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 => match Avx512::detect() {
            Some(s) => avx512::enter(s, kernel),
            None => kernel.run(Portable),
        },
        #[cfg(target_arch = "x86_64")]
        Isa::Avx2 => match Avx2::detect() {
            Some(s) => avx2::enter(s, kernel),
            None => kernel.run(Portable),
        },
        // Part of the target: no function of its own is needed to enable it.
        #[cfg(target_arch = "aarch64")]
        Isa::Neon => kernel.run(neon::Neon),
        _ => kernel.run(Portable),
    }
}

/// Sixteen lanes of f32.
pub(crate) trait Simd: Copy {
    /// Sixteen numbers.
    type F: Copy;
    /// Sixteen truth values.
    type M: Copy;

    fn splat(self, x: f32) -> Self::F;
    fn load(self, x: &[f32; 16]) -> Self::F;
    fn store(self, x: Self::F, to: &mut [f32; 16]);
    /// Four rows of four numbers, `stride` apart, from `at` on.
    fn load_4x4(self, from: &[f32], at: usize, stride: usize) -> Self::F;
    fn store_4x4(self, x: Self::F, to: &mut [f32], at: usize, stride: usize);

    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// a * b + c
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c - a * b
    fn fnma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The second operand where one is NaN.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// The second operand where one is NaN.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    fn sqrt(self, a: Self::F) -> Self::F;
    /// 1 / a to at least 14 bits, for a in the normal range.
    fn reciprocal_14(self, a: Self::F) -> Self::F;
    fn abs(self, a: Self::F) -> Self::F;
    /// Largest whole number not above a.
    fn floor(self, a: Self::F) -> Self::F;
    /// Bits a | b << 16 of whole numbers from 0 to 65535; anything for other numbers.
    fn pack_u16(self, a: Self::F, b: Self::F) -> Self::F;

    /// a >= b; false where one is NaN.
    fn ge(self, a: Self::F, b: Self::F) -> Self::M;
    /// a > b; false where one is NaN.
    fn gt(self, a: Self::F, b: Self::F) -> Self::M;
    fn and(self, a: Self::M, b: Self::M) -> Self::M;
    /// Lane i is bit i.
    fn bits(self, m: Self::M) -> u16;
    fn mask(self, bits: u16) -> Self::M;
    /// a where the mask holds, else b.
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// a where the mask holds, else 0.
    fn keep(self, m: Self::M, a: Self::F) -> Self::F;

    /// (r, n) with 2^x = 2^r * scale(., n) and r in [0, 1).
    fn exp2_split(self, x: Self::F) -> (Self::F, Self::F);
    /// p * 2^floor(n), for the n of [`Simd::exp2_split`]; 0 below the range of normal numbers.
    fn exp2_scale(self, p: Self::F, n: Self::F) -> Self::F;
    /// (e, m) with x = m * 2^e and m in [1, 2), for positive normal x.
    fn exponent_mantissa(self, x: Self::F) -> (Self::F, Self::F);

    /// Transposes 16 rows of 16 lanes.
    fn transpose(self, rows: &mut [Self::F; 16]);
    // Vectors as four groups of four lanes, the rows of a 4x4 block of pixels: lane 4 j + i is number i of group j. The
    // defaults go through memory; an instruction set overrides what it is good at.

    /// Number i in lane i of every group.
    #[inline(always)]
    fn splat_four(self, x: [f32; 4]) -> Self::F {
        self.load(&build!(0.0; 16; |lane| x[lane % 4]))
    }
    /// Number j in all lanes of group j.
    #[inline(always)]
    fn splat_groups(self, x: [f32; 4]) -> Self::F {
        self.load(&build!(0.0; 16; |lane| x[lane / 4]))
    }
    /// Number i of each group in all lanes of that group.
    #[inline(always)]
    fn spread(self, x: Self::F, i: usize) -> Self::F {
        let mut lanes = [0.0; 16];
        self.store(x, &mut lanes);
        self.load(&build!(0.0; 16; |lane| lanes[lane / 4 * 4 + i % 4]))
    }
    /// Transposes the groups: lane s of group j of result i is lane i of group j of operand s.
    #[inline(always)]
    fn transpose_groups(self, x: [Self::F; 4]) -> [Self::F; 4] {
        let mut from = [[0.0; 16]; 4];
        for s in 0..4 {
            self.store(x[s], &mut from[s]);
        }
        build!(x[0]; 4; |i| self.load(&build!(0.0; 16; |lane| from[lane % 4][lane / 4 * 4 + i])))
    }
    /// Adds up groups: lane s of group q is the sum over the groups j of lane s of operand q.
    #[inline(always)]
    fn sum_groups(self, x: [Self::F; 4]) -> Self::F {
        let mut from = [[0.0; 16]; 4];
        for q in 0..4 {
            self.store(x[q], &mut from[q]);
        }
        self.load(&build!(0.0; 16; |lane| {
            let (q, s) = (&from[lane / 4], lane % 4);
            (q[s] + q[4 + s]) + (q[8 + s] + q[12 + s])
        }))
    }
    /// Rows from columns: lane 4 m + q of result s is lane s of group q of operand m; lanes 12 to 15 are 0.
    #[inline(always)]
    fn rows_of_groups(self, x: [Self::F; 3]) -> [Self::F; 4] {
        let mut from = [[0.0; 16]; 4];
        for m in 0..3 {
            self.store(x[m], &mut from[m]);
        }
        build!(x[0]; 4; |s| self.load(&build!(0.0; 16; |lane| from[lane / 4][lane % 4 * 4 + s])))
    }

    /// Writes, for each lane i of the mask, the number `first + i` to the beginning of `to`, and says how many there
    /// were. All sixteen numbers of `to` may be overwritten.
    #[inline(always)]
    fn append(self, mask: Self::M, first: u16, to: &mut [u16]) -> usize {
        let mut bits = self.bits(mask);
        let mut count = 0;
        while bits != 0 {
            to[count] = first + bits.trailing_zeros() as u16;
            bits &= bits - 1;
            count += 1;
        }
        count
    }

    /// 2^x with a degree-4 polynomial (relative error 4e-6), for alphas.
    #[inline(always)]
    fn exp2_fast(self, x: Self::F) -> Self::F {
        let (r, n) = self.exp2_split(x);
        self.exp2_scale(polynomial(self, &EXP2_4, r), n)
    }

    /// 2^x to f32 accuracy.
    #[inline(always)]
    fn exp2(self, x: Self::F) -> Self::F {
        let (r, n) = self.exp2_split(x);
        self.exp2_scale(polynomial(self, &EXP2_6, r), n)
    }

    /// e^x to f32 accuracy for moderate x.
    #[inline(always)]
    fn exp(self, x: Self::F) -> Self::F {
        self.exp2(self.mul(x, self.splat(std::f32::consts::LOG2_E)))
    }

    /// Base-2 logarithm of positive normal numbers, by the series of atanh.
    #[inline(always)]
    fn log2(self, x: Self::F) -> Self::F {
        let (e, m) = self.exponent_mantissa(x);
        let one = self.splat(1.0);
        // Centre the mantissa on 1, so that the series is short and exact near 1.
        let high = self.gt(m, self.splat(std::f32::consts::SQRT_2));
        let m = self.select(high, self.mul(m, self.splat(0.5)), m);
        let e = self.select(high, self.add(e, one), e);
        let s = self.div(self.sub(m, one), self.add(m, one));
        let s2 = self.mul(s, s);
        let p = polynomial(self, &[1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0], s2);
        self.fma(self.mul(s, p), self.splat(2.0 * std::f32::consts::LOG2_E), e)
    }
}

/// Polynomial with the highest power first.
#[inline(always)]
fn polynomial<S: Simd, const N: usize>(s: S, coefficients: &[f32; N], x: S::F) -> S::F {
    let mut p = s.splat(coefficients[0]);
    for c in &coefficients[1..] {
        p = s.fma(p, x, s.splat(*c));
    }
    p
}

/// An array built by a loop: `build!(first; length; |i| value)`.
///
/// Kernels do not use `array::from_fn`, `map` or closures on vectors: a closure is a function of its own, which is
/// compiled without the instruction set of the kernel around it and then called with vectors in memory (ten times
/// slower, measured).
macro_rules! build {
    ($first:expr; $length:expr; |$i:ident| $value:expr) => {{
        let mut out = [$first; $length];
        let mut $i = 0;
        while $i < $length {
            out[$i] = $value;
            $i += 1;
        }
        out
    }};
}
pub(crate) use build;

// Minimax polynomials of 2^r on [0, 1), relative error, highest power first.
const EXP2_4: [f32; 5] = [0.013534168, 0.05201146, 0.24144275, 0.69300383, 1.0000026];
#[expect(clippy::approx_constant, reason = "a minimax coefficient lies near ln 2 and is not it")]
const EXP2_6: [f32; 7] = [0.00021702256, 0.0012439687, 0.009678841, 0.05548334, 0.24022983, 0.693147, 1.0];

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs a few operations on every set and returns what they gave.
    struct Probe([f32; 16]);

    impl Kernel for Probe {
        type Output = Vec<[f32; 16]>;
        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Self::Output {
            let x = s.load(&self.0);
            let mut rows = [x; 16];
            for (i, row) in rows.iter_mut().enumerate() {
                *row = s.add(x, s.splat(100.0 * i as f32));
            }
            let groups = s.sum_groups([rows[0], rows[1], rows[2], rows[3]]);
            let turned = s.transpose_groups([rows[0], rows[1], rows[2], rows[3]]);
            let columns = s.rows_of_groups([rows[0], rows[1], rows[2]]);
            let mut lanes = [0.0; 16];
            s.store(x, &mut lanes);
            let four = s.splat_four([lanes[0], lanes[1], lanes[2], lanes[3]]);
            let by_group = s.splat_groups([lanes[0], lanes[1], lanes[2], lanes[3]]);
            let spread = s.spread(x, 2);
            s.transpose(&mut rows);
            let mut image = vec![0.0; 64];
            s.store_4x4(x, &mut image, 5, 12);
            let block = s.load_4x4(&image, 5, 12);
            let mask = s.ge(x, s.splat(0.5));
            let again = s.mask(s.bits(mask));
            let out = [
                s.exp2(x),
                s.exp2_fast(x),
                s.log2(s.add(s.abs(x), s.splat(1e-6))),
                s.reciprocal_14(s.add(s.abs(x), s.splat(0.1))),
                rows[3],
                groups,
                turned[1],
                columns[3],
                four,
                by_group,
                spread,
                block,
                s.keep(again, x),
                s.select(mask, s.splat(1.0), s.splat(-1.0)),
                s.sqrt(s.abs(x)),
                s.floor(x),
                s.pack_u16(s.floor(s.abs(x)), s.splat(259.0)),
            ];
            check_append(s);
            out.iter()
                .map(|&v| {
                    let mut lanes = [0.0; 16];
                    s.store(v, &mut lanes);
                    lanes
                })
                .collect()
        }
    }

    /// Appending writes the numbers of the lanes of a mask, in order.
    #[inline(always)]
    fn check_append<S: Simd>(s: S) {
        for bits in [0_u16, 1, 0x8000, 0xffff, 0x9e37, 0x4210] {
            let mut to = [7_u16; 40];
            let count = s.append(s.mask(bits), 32, &mut to[5..]);
            let expected: Vec<u16> = (0..16).filter(|i| bits >> i & 1 == 1).map(|i| 32 + i).collect();
            assert_eq!(to[5..5 + count], expected);
            assert!(to[..5].iter().chain(&to[21..]).all(|&v| v == 7));
        }
    }

    fn expected(x: [f32; 16]) -> Vec<[f32; 16]> {
        let map = |f: &dyn Fn(f64) -> f64| x.map(|v| f(f64::from(v)) as f32);
        let sum = |i: usize| (0..4).map(|j| f64::from(x[4 * j + i % 4])).sum::<f64>() + 400.0 * (i / 4) as f64;
        vec![
            map(&f64::exp2),
            map(&f64::exp2),
            map(&|v| (v.abs() + 1e-6).log2()),
            map(&|v| 1.0 / (v.abs() + 0.1)),
            std::array::from_fn(|i| x[3] + 100.0 * i as f32),
            std::array::from_fn(|i| sum(i) as f32),
            std::array::from_fn(|i| x[i / 4 * 4 + 1] + 100.0 * (i % 4) as f32),
            std::array::from_fn(|i| if i < 12 { x[i % 4 * 4 + 3] + 100.0 * (i / 4) as f32 } else { 0.0 }),
            std::array::from_fn(|i| x[i % 4]),
            std::array::from_fn(|i| x[i / 4]),
            std::array::from_fn(|i| x[i / 4 * 4 + 2]),
            x,
            x.map(|v| if v >= 0.5 { v } else { 0.0 }),
            x.map(|v| if v >= 0.5 { 1.0 } else { -1.0 }),
            map(&|v| v.abs().sqrt()),
            map(&f64::floor),
            x.map(|v| f32::from_bits(v.abs() as u32 | 259 << 16)),
        ]
    }

    #[test]
    fn every_instruction_set_computes_the_same_thing() {
        let inputs: [[f32; 16]; 3] = [
            std::array::from_fn(|i| -9.0 + 1.3 * i as f32),
            std::array::from_fn(|i| 0.01 * i as f32 + 0.45),
            std::array::from_fn(|i| -100.0 + 13.0 * i as f32),
        ];
        // Relative error allowed for each probe; the third is absolute near log2(1) = 0.
        let tolerance = [4e-7, 6e-6, 3e-7, 1e-4, 1e-6, 1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2e-7, 0.0, 0.0];
        let mut ran = 0;
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            for x in inputs {
                let got = dispatch(isa, Probe(x));
                for ((got, want), tolerance) in got.iter().zip(expected(x)).zip(tolerance) {
                    for (g, w) in got.iter().zip(want) {
                        assert!((g - w).abs() <= tolerance * w.abs().max(1.0e-3), "{isa:?}: {g} instead of {w}");
                    }
                }
                ran += 1;
            }
        }
        assert!(ran >= 3);
    }

    #[test]
    fn exp2_underflows_to_zero() {
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            let got = dispatch(isa, Probe([-1e9; 16]));
            assert!(got[0].iter().chain(&got[1]).all(|v| v.abs() < 1e-37), "{isa:?}: {got:?}");
        }
    }
}
