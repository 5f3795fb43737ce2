//! NEON on 64-bit ARM, where it is part of every machine: sixteen lanes are four registers, masks are full-width.

#![expect(unsafe_code, reason = "loads and stores of vectors")]

use std::arch::aarch64::*;

use super::{Simd, build};

/// The instruction set is part of the target, so there is nothing to detect.
#[derive(Clone, Copy)]
pub(super) struct Neon;

/// Lanes 4 i to 4 i + 3 in register i: also the groups of the 4x4 operations.
type Four = [float32x4_t; 4];
type Mask = [uint32x4_t; 4];

/// An expression of intrinsics.
macro_rules! with_neon {
    ($e:expr) => {
        // SAFETY: NEON is part of the target, and pointers given to loads and stores come from references or slices that
        // hold the four numbers which the instruction touches.
        unsafe { $e }
    };
}

/// An array of what an expression of intrinsics gives for every register `i`.
macro_rules! each {
    (|$i:ident| $value:expr) => {{
        let part = |$i: usize| with_neon!($value);
        [part(0), part(1), part(2), part(3)]
    }};
}

/// Lane i of the four registers has bit i.
const LANE_BITS: [[u32; 4]; 4] = [
    [1, 2, 4, 8],
    [1 << 4, 1 << 5, 1 << 6, 1 << 7],
    [1 << 8, 1 << 9, 1 << 10, 1 << 11],
    [1 << 12, 1 << 13, 1 << 14, 1 << 15],
];

#[inline(always)]
fn lane_bits(register: usize) -> uint32x4_t {
    with_neon!(vld1q_u32(LANE_BITS[register].as_ptr()))
}

#[inline(always)]
fn load_4(from: &[f32; 4]) -> float32x4_t {
    with_neon!(vld1q_f32(from.as_ptr()))
}

/// Transposes four rows of four numbers.
#[inline(always)]
fn transpose_4([a, b, c, d]: Four) -> Four {
    with_neon!({
        let (ab_even, ab_odd) = (vreinterpretq_f64_f32(vtrn1q_f32(a, b)), vreinterpretq_f64_f32(vtrn2q_f32(a, b)));
        let (cd_even, cd_odd) = (vreinterpretq_f64_f32(vtrn1q_f32(c, d)), vreinterpretq_f64_f32(vtrn2q_f32(c, d)));
        [
            vreinterpretq_f32_f64(vtrn1q_f64(ab_even, cd_even)),
            vreinterpretq_f32_f64(vtrn1q_f64(ab_odd, cd_odd)),
            vreinterpretq_f32_f64(vtrn2q_f64(ab_even, cd_even)),
            vreinterpretq_f32_f64(vtrn2q_f64(ab_odd, cd_odd)),
        ]
    })
}

impl Simd for Neon {
    type F = Four;
    type M = Mask;

    #[inline(always)]
    fn splat(self, x: f32) -> Four {
        [with_neon!(vdupq_n_f32(x)); 4]
    }
    #[inline(always)]
    fn load(self, x: &[f32; 16]) -> Four {
        each!(|i| vld1q_f32(x.as_ptr().add(4 * i)))
    }
    #[inline(always)]
    fn store(self, x: Four, to: &mut [f32; 16]) {
        for (i, x) in x.into_iter().enumerate() {
            with_neon!(vst1q_f32(to.as_mut_ptr().add(4 * i), x));
        }
    }
    #[inline(always)]
    fn load_4x4(self, from: &[f32], at: usize, stride: usize) -> Four {
        let from = &from[at..at + 3 * stride + 4];
        each!(|i| vld1q_f32(from.as_ptr().add(i * stride)))
    }
    #[inline(always)]
    fn store_4x4(self, x: Four, to: &mut [f32], at: usize, stride: usize) {
        let to = &mut to[at..at + 3 * stride + 4];
        for (i, x) in x.into_iter().enumerate() {
            with_neon!(vst1q_f32(to.as_mut_ptr().add(i * stride), x));
        }
    }
    #[inline(always)]
    fn add(self, a: Four, b: Four) -> Four {
        each!(|i| vaddq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn sub(self, a: Four, b: Four) -> Four {
        each!(|i| vsubq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn mul(self, a: Four, b: Four) -> Four {
        each!(|i| vmulq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn div(self, a: Four, b: Four) -> Four {
        each!(|i| vdivq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn fma(self, a: Four, b: Four, c: Four) -> Four {
        each!(|i| vfmaq_f32(c[i], a[i], b[i]))
    }
    #[inline(always)]
    fn fnma(self, a: Four, b: Four, c: Four) -> Four {
        each!(|i| vfmsq_f32(c[i], a[i], b[i]))
    }
    #[inline(always)]
    fn min(self, a: Four, b: Four) -> Four {
        // The instruction of that name gives NaN where one is NaN.
        each!(|i| vbslq_f32(vcltq_f32(a[i], b[i]), a[i], b[i]))
    }
    #[inline(always)]
    fn max(self, a: Four, b: Four) -> Four {
        each!(|i| vbslq_f32(vcgtq_f32(a[i], b[i]), a[i], b[i]))
    }
    #[inline(always)]
    fn sqrt(self, a: Four) -> Four {
        each!(|i| vsqrtq_f32(a[i]))
    }
    #[inline(always)]
    fn reciprocal_14(self, a: Four) -> Four {
        // The estimate gives 8 bits; one Newton step doubles them.
        each!(|i| {
            let x = vrecpeq_f32(a[i]);
            vmulq_f32(x, vrecpsq_f32(a[i], x))
        })
    }
    #[inline(always)]
    fn abs(self, a: Four) -> Four {
        each!(|i| vabsq_f32(a[i]))
    }
    #[inline(always)]
    fn floor(self, a: Four) -> Four {
        each!(|i| vrndmq_f32(a[i]))
    }
    #[inline(always)]
    fn pack_u16(self, a: Four, b: Four) -> Four {
        each!(|i| {
            let high = vshlq_n_u32::<16>(vcvtq_u32_f32(b[i]));
            vreinterpretq_f32_u32(vorrq_u32(vcvtq_u32_f32(a[i]), high))
        })
    }
    #[inline(always)]
    fn ge(self, a: Four, b: Four) -> Mask {
        each!(|i| vcgeq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn gt(self, a: Four, b: Four) -> Mask {
        each!(|i| vcgtq_f32(a[i], b[i]))
    }
    #[inline(always)]
    fn and(self, a: Mask, b: Mask) -> Mask {
        each!(|i| vandq_u32(a[i], b[i]))
    }
    #[inline(always)]
    fn bits(self, m: Mask) -> u16 {
        let bits = each!(|i| vandq_u32(m[i], lane_bits(i)));
        with_neon!(vaddvq_u32(vorrq_u32(vorrq_u32(bits[0], bits[1]), vorrq_u32(bits[2], bits[3])))) as u16
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> Mask {
        let bits = with_neon!(vdupq_n_u32(u32::from(bits)));
        each!(|i| vtstq_u32(bits, lane_bits(i)))
    }
    #[inline(always)]
    fn select(self, m: Mask, a: Four, b: Four) -> Four {
        each!(|i| vbslq_f32(m[i], a[i], b[i]))
    }
    #[inline(always)]
    fn keep(self, m: Mask, a: Four) -> Four {
        each!(|i| vreinterpretq_f32_u32(vandq_u32(m[i], vreinterpretq_u32_f32(a[i]))))
    }
    #[inline(always)]
    fn exp2_split(self, x: Four) -> (Four, Four) {
        // The clamp keeps the exponent of the scale inside the normal range; at its lower end the scale is 0.
        let x = self.min(self.max(x, self.splat(-127.0)), self.splat(127.0));
        let n = self.floor(x);
        (self.sub(x, n), n)
    }
    #[inline(always)]
    fn exp2_scale(self, p: Four, n: Four) -> Four {
        let scale = each!(|i| {
            let biased = vaddq_s32(vcvtq_s32_f32(n[i]), vdupq_n_s32(127));
            vreinterpretq_f32_s32(vshlq_n_s32::<23>(biased))
        });
        self.mul(p, scale)
    }
    #[inline(always)]
    fn exponent_mantissa(self, x: Four) -> (Four, Four) {
        let exponent = each!(|i| {
            let biased = vreinterpretq_s32_u32(vshrq_n_u32::<23>(vreinterpretq_u32_f32(x[i])));
            vcvtq_f32_s32(vsubq_s32(biased, vdupq_n_s32(127)))
        });
        let mantissa = each!(|i| {
            let fraction = vandq_u32(vreinterpretq_u32_f32(x[i]), vdupq_n_u32(0x007f_ffff));
            vreinterpretq_f32_u32(vorrq_u32(fraction, vdupq_n_u32(0x3f80_0000)))
        });
        (exponent, mantissa)
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [Four; 16]) {
        let from = *rows;
        for row_group in 0..4 {
            for column_group in 0..4 {
                let turned = transpose_4(build!(from[0][0]; 4; |i| from[4 * row_group + i][column_group]));
                for i in 0..4 {
                    rows[4 * column_group + i][row_group] = turned[i];
                }
            }
        }
    }
    #[inline(always)]
    fn splat_four(self, x: [f32; 4]) -> Four {
        [load_4(&x); 4]
    }
    #[inline(always)]
    fn splat_groups(self, x: [f32; 4]) -> Four {
        each!(|i| vdupq_n_f32(x[i]))
    }
    #[inline(always)]
    fn spread(self, x: Four, i: usize) -> Four {
        match i % 4 {
            0 => each!(|j| vdupq_laneq_f32::<0>(x[j])),
            1 => each!(|j| vdupq_laneq_f32::<1>(x[j])),
            2 => each!(|j| vdupq_laneq_f32::<2>(x[j])),
            _ => each!(|j| vdupq_laneq_f32::<3>(x[j])),
        }
    }
    #[inline(always)]
    fn transpose_groups(self, x: [Four; 4]) -> [Four; 4] {
        let groups = build!(x[0]; 4; |j| transpose_4([x[0][j], x[1][j], x[2][j], x[3][j]]));
        build!(x[0]; 4; |i| [groups[0][i], groups[1][i], groups[2][i], groups[3][i]])
    }
    #[inline(always)]
    fn sum_groups(self, x: [Four; 4]) -> Four {
        each!(|q| vaddq_f32(vaddq_f32(x[q][0], x[q][1]), vaddq_f32(x[q][2], x[q][3])))
    }
    #[inline(always)]
    fn rows_of_groups(self, x: [Four; 3]) -> [Four; 4] {
        let zero = with_neon!(vdupq_n_f32(0.0));
        let columns = build!(x[0]; 3; |m| transpose_4(x[m]));
        build!(x[0]; 4; |s| [columns[0][s], columns[1][s], columns[2][s], zero])
    }
}
