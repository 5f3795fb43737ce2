//! AVX2 with FMA: sixteen lanes are two registers, masks are full-width registers.

#![expect(unsafe_code, reason = "vector intrinsics")]

use std::arch::x86_64::*;

use super::{Kernel, Simd, build};

/// Proof that the machine has AVX2 and FMA: only [`Avx2::detect`] makes one.
#[derive(Clone, Copy)]
pub(super) struct Avx2(());

impl Avx2 {
    pub(super) fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
}

/// Runs a kernel compiled for AVX2 with FMA.
pub(super) fn enter<K: Kernel>(s: Avx2, kernel: K) -> K::Output {
    #[target_feature(enable = "avx2,fma")]
    fn inner<K: Kernel>(s: Avx2, kernel: K) -> K::Output {
        kernel.run(s)
    }
    // SAFETY: `s` proves AVX2 and FMA.
    unsafe { inner(s, kernel) }
}

/// An expression of intrinsics, allowed because a `self` of this type exists.
macro_rules! with_avx2 {
    ($e:expr) => {
        // SAFETY: a value of `Avx2` exists only where AVX2 and FMA were detected, and pointers given to loads and stores
        // come from references to as many numbers as the instruction touches.
        unsafe { $e }
    };
}

/// Lanes 0 to 7 and 8 to 15.
type Pair = (__m256, __m256);

/// Sums of the two 128-bit lanes of x and of y.
#[inline(always)]
fn lanes(_proof: Avx2, x: __m256, y: __m256) -> __m256 {
    with_avx2!(_mm256_add_ps(_mm256_permute2f128_ps::<0x20>(x, y), _mm256_permute2f128_ps::<0x31>(x, y)))
}

/// Transposes the 4x4 numbers in each half of four vectors.
#[inline(always)]
fn transpose_4(_proof: Avx2, r: [__m256; 4]) -> [__m256; 4] {
    with_avx2!({
        let ab_low = _mm256_castps_pd(_mm256_unpacklo_ps(r[0], r[1]));
        let ab_high = _mm256_castps_pd(_mm256_unpackhi_ps(r[0], r[1]));
        let cd_low = _mm256_castps_pd(_mm256_unpacklo_ps(r[2], r[3]));
        let cd_high = _mm256_castps_pd(_mm256_unpackhi_ps(r[2], r[3]));
        [
            _mm256_castpd_ps(_mm256_unpacklo_pd(ab_low, cd_low)),
            _mm256_castpd_ps(_mm256_unpackhi_pd(ab_low, cd_low)),
            _mm256_castpd_ps(_mm256_unpacklo_pd(ab_high, cd_high)),
            _mm256_castpd_ps(_mm256_unpackhi_pd(ab_high, cd_high)),
        ]
    })
}

/// Transposes eight rows of eight numbers.
#[inline(always)]
fn transpose_8(proof: Avx2, r: [__m256; 8]) -> [__m256; 8] {
    with_avx2!({
        let (top, bottom) =
            (transpose_4(proof, [r[0], r[1], r[2], r[3]]), transpose_4(proof, [r[4], r[5], r[6], r[7]]));
        let low = build!(r[0]; 4; |i| _mm256_permute2f128_ps::<0x20>(top[i], bottom[i]));
        let high = build!(r[0]; 4; |i| _mm256_permute2f128_ps::<0x31>(top[i], bottom[i]));
        [low[0], low[1], low[2], low[3], high[0], high[1], high[2], high[3]]
    })
}

/// The number 2^n for whole n of -127 (then 0) to 127.
#[inline(always)]
fn power_of_two(_proof: Avx2, n: __m256) -> __m256 {
    with_avx2!({
        let biased = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
        _mm256_castsi256_ps(_mm256_slli_epi32::<23>(biased))
    })
}

/// Exponent and mantissa in [1, 2) of positive normal numbers.
#[inline(always)]
fn take_apart(_proof: Avx2, x: __m256) -> (__m256, __m256) {
    with_avx2!({
        let bits = _mm256_castps_si256(x);
        let exponent = _mm256_sub_epi32(_mm256_srli_epi32::<23>(bits), _mm256_set1_epi32(127));
        let fraction = _mm256_and_si256(bits, _mm256_set1_epi32(0x007f_ffff));
        let mantissa = _mm256_or_si256(fraction, _mm256_set1_epi32(0x3f80_0000));
        (_mm256_cvtepi32_ps(exponent), _mm256_castsi256_ps(mantissa))
    })
}

/// Bits a | b << 16 of whole numbers.
#[inline(always)]
fn pack_u16(_proof: Avx2, a: __m256, b: __m256) -> __m256 {
    with_avx2!({
        let high = _mm256_slli_epi32::<16>(_mm256_cvttps_epi32(b));
        _mm256_castsi256_ps(_mm256_or_si256(_mm256_cvttps_epi32(a), high))
    })
}

/// A mask from the low eight bits.
#[inline(always)]
fn mask_8(_proof: Avx2, bits: i32) -> __m256 {
    with_avx2!({
        let each = _mm256_set_epi32(128, 64, 32, 16, 8, 4, 2, 1);
        _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(bits), each), each))
    })
}

impl Simd for Avx2 {
    type F = Pair;
    type M = Pair;

    #[inline(always)]
    fn splat(self, x: f32) -> Pair {
        let x = with_avx2!(_mm256_set1_ps(x));
        (x, x)
    }
    #[inline(always)]
    fn load(self, x: &[f32; 16]) -> Pair {
        with_avx2!((_mm256_loadu_ps(x.as_ptr()), _mm256_loadu_ps(x.as_ptr().add(8))))
    }
    #[inline(always)]
    fn store(self, x: Pair, to: &mut [f32; 16]) {
        with_avx2!({
            _mm256_storeu_ps(to.as_mut_ptr(), x.0);
            _mm256_storeu_ps(to.as_mut_ptr().add(8), x.1);
        })
    }
    #[inline(always)]
    fn load_4x4(self, from: &[f32], at: usize, stride: usize) -> Pair {
        let from = &from[at..at + 3 * stride + 4];
        with_avx2!({
            let p = from.as_ptr();
            (
                _mm256_set_m128(_mm_loadu_ps(p.add(stride)), _mm_loadu_ps(p)),
                _mm256_set_m128(_mm_loadu_ps(p.add(3 * stride)), _mm_loadu_ps(p.add(2 * stride))),
            )
        })
    }
    #[inline(always)]
    fn store_4x4(self, x: Pair, to: &mut [f32], at: usize, stride: usize) {
        let to = &mut to[at..at + 3 * stride + 4];
        with_avx2!({
            let p = to.as_mut_ptr();
            _mm_storeu_ps(p, _mm256_castps256_ps128(x.0));
            _mm_storeu_ps(p.add(stride), _mm256_extractf128_ps::<1>(x.0));
            _mm_storeu_ps(p.add(2 * stride), _mm256_castps256_ps128(x.1));
            _mm_storeu_ps(p.add(3 * stride), _mm256_extractf128_ps::<1>(x.1));
        })
    }
    #[inline(always)]
    fn add(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn sub(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_sub_ps(a.0, b.0), _mm256_sub_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn mul(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn div(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_div_ps(a.0, b.0), _mm256_div_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn fma(self, a: Pair, b: Pair, c: Pair) -> Pair {
        with_avx2!((_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)))
    }
    #[inline(always)]
    fn fnma(self, a: Pair, b: Pair, c: Pair) -> Pair {
        with_avx2!((_mm256_fnmadd_ps(a.0, b.0, c.0), _mm256_fnmadd_ps(a.1, b.1, c.1)))
    }
    #[inline(always)]
    fn min(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_min_ps(a.0, b.0), _mm256_min_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn max(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_max_ps(a.0, b.0), _mm256_max_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn sqrt(self, a: Pair) -> Pair {
        with_avx2!((_mm256_sqrt_ps(a.0), _mm256_sqrt_ps(a.1)))
    }
    #[inline(always)]
    fn reciprocal_14(self, a: Pair) -> Pair {
        // The instruction gives 11 bits; one Newton step doubles them.
        let x = with_avx2!((_mm256_rcp_ps(a.0), _mm256_rcp_ps(a.1)));
        self.mul(x, self.fnma(a, x, self.splat(2.0)))
    }
    #[inline(always)]
    fn abs(self, a: Pair) -> Pair {
        let sign = self.splat(-0.0);
        with_avx2!((_mm256_andnot_ps(sign.0, a.0), _mm256_andnot_ps(sign.1, a.1)))
    }
    #[inline(always)]
    fn floor(self, a: Pair) -> Pair {
        with_avx2!((_mm256_floor_ps(a.0), _mm256_floor_ps(a.1)))
    }
    #[inline(always)]
    fn pack_u16(self, a: Pair, b: Pair) -> Pair {
        (pack_u16(self, a.0, b.0), pack_u16(self, a.1, b.1))
    }
    #[inline(always)]
    fn ge(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_cmp_ps::<_CMP_GE_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_GE_OQ>(a.1, b.1)))
    }
    #[inline(always)]
    fn gt(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_cmp_ps::<_CMP_GT_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_GT_OQ>(a.1, b.1)))
    }
    #[inline(always)]
    fn and(self, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_and_ps(a.0, b.0), _mm256_and_ps(a.1, b.1)))
    }
    #[inline(always)]
    fn bits(self, m: Pair) -> u16 {
        with_avx2!((_mm256_movemask_ps(m.0) | _mm256_movemask_ps(m.1) << 8) as u16)
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> Pair {
        (mask_8(self, i32::from(bits)), mask_8(self, i32::from(bits >> 8)))
    }
    #[inline(always)]
    fn select(self, m: Pair, a: Pair, b: Pair) -> Pair {
        with_avx2!((_mm256_blendv_ps(b.0, a.0, m.0), _mm256_blendv_ps(b.1, a.1, m.1)))
    }
    #[inline(always)]
    fn keep(self, m: Pair, a: Pair) -> Pair {
        self.and(m, a)
    }
    #[inline(always)]
    fn exp2_split(self, x: Pair) -> (Pair, Pair) {
        // The clamp keeps the exponent of the scale inside the normal range; at its lower end the scale is 0.
        let x = self.min(self.max(x, self.splat(-127.0)), self.splat(127.0));
        let n = with_avx2!((_mm256_floor_ps(x.0), _mm256_floor_ps(x.1)));
        (self.sub(x, n), n)
    }
    #[inline(always)]
    fn exp2_scale(self, p: Pair, n: Pair) -> Pair {
        self.mul(p, (power_of_two(self, n.0), power_of_two(self, n.1)))
    }
    #[inline(always)]
    fn exponent_mantissa(self, x: Pair) -> (Pair, Pair) {
        let (low, high) = (take_apart(self, x.0), take_apart(self, x.1));
        ((low.0, high.0), (low.1, high.1))
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [Pair; 16]) {
        let top_left = transpose_8(self, build!(rows[0].0; 8; |i| rows[i].0));
        let top_right = transpose_8(self, build!(rows[0].0; 8; |i| rows[i].1));
        let bottom_left = transpose_8(self, build!(rows[0].0; 8; |i| rows[8 + i].0));
        let bottom_right = transpose_8(self, build!(rows[0].0; 8; |i| rows[8 + i].1));
        for i in 0..8 {
            rows[i] = (top_left[i], bottom_left[i]);
            rows[8 + i] = (top_right[i], bottom_right[i]);
        }
    }
    #[inline(always)]
    fn splat_four(self, x: [f32; 4]) -> Pair {
        let x = with_avx2!(_mm256_set_m128(_mm_setr_ps(x[0], x[1], x[2], x[3]), _mm_setr_ps(x[0], x[1], x[2], x[3])));
        (x, x)
    }
    #[inline(always)]
    fn transpose_groups(self, x: [Pair; 4]) -> [Pair; 4] {
        let low = transpose_4(self, build!(x[0].0; 4; |i| x[i].0));
        let high = transpose_4(self, build!(x[0].0; 4; |i| x[i].1));
        build!(x[0]; 4; |i| (low[i], high[i]))
    }
    #[inline(always)]
    fn sum_groups(self, x: [Pair; 4]) -> Pair {
        let x = build!(x[0].0; 4; |i| with_avx2!(_mm256_add_ps(x[i].0, x[i].1)));
        (lanes(self, x[0], x[1]), lanes(self, x[2], x[3]))
    }
    #[inline(always)]
    fn rows_of_groups(self, x: [Pair; 3]) -> [Pair; 4] {
        with_avx2!({
            // Each half holds the groups (q, q + 1): a 4x4 transpose across the halves makes rows of them.
            let groups = build!([_mm_setzero_ps(); 4]; 3; |m| {
                let q = [
                    _mm256_castps256_ps128(x[m].0),
                    _mm256_extractf128_ps::<1>(x[m].0),
                    _mm256_castps256_ps128(x[m].1),
                    _mm256_extractf128_ps::<1>(x[m].1),
                ];
                let (ab_low, ab_high) = (_mm_unpacklo_ps(q[0], q[1]), _mm_unpackhi_ps(q[0], q[1]));
                let (cd_low, cd_high) = (_mm_unpacklo_ps(q[2], q[3]), _mm_unpackhi_ps(q[2], q[3]));
                [
                    _mm_movelh_ps(ab_low, cd_low),
                    _mm_movehl_ps(cd_low, ab_low),
                    _mm_movelh_ps(ab_high, cd_high),
                    _mm_movehl_ps(cd_high, ab_high),
                ]
            });
            build!(x[0]; 4; |s| {
                (_mm256_set_m128(groups[1][s], groups[0][s]), _mm256_set_m128(_mm_setzero_ps(), groups[2][s]))
            })
        })
    }
}
