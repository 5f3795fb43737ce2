//! AVX-512: sixteen lanes are one register, masks are mask registers.

#![expect(unsafe_code, reason = "vector intrinsics")]

use std::arch::x86_64::*;

use super::{Kernel, Simd};

/// Proof that the machine has AVX-512 F, DQ and VL: only [`Avx512::detect`] makes one.
#[derive(Clone, Copy)]
pub(super) struct Avx512(());

impl Avx512 {
    pub(super) fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl"))
        .then_some(Self(()))
    }
}

/// Runs a kernel compiled for AVX-512.
pub(super) fn enter<K: Kernel>(s: Avx512, kernel: K) -> K::Output {
    #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
    fn inner<K: Kernel>(s: Avx512, kernel: K) -> K::Output {
        kernel.run(s)
    }
    // SAFETY: `s` proves the AVX-512 features; every processor with AVX-512 F has AVX2, FMA and the bit instructions.
    unsafe { inner(s, kernel) }
}

/// An expression of intrinsics, allowed because a `self` of this type exists.
macro_rules! with_avx512 {
    ($e:expr) => {
        // SAFETY: a value of `Avx512` exists only where AVX-512 F, DQ and VL were detected, and pointers given to loads
        // and stores come from references to as many numbers as the instruction touches.
        unsafe { $e }
    };
}

/// Sums of pairs of 128-bit lanes of x and of y.
#[inline(always)]
fn lanes(_proof: Avx512, x: __m512, y: __m512) -> __m512 {
    with_avx512!(_mm512_add_ps(_mm512_shuffle_f32x4::<0x88>(x, y), _mm512_shuffle_f32x4::<0xdd>(x, y)))
}

impl Simd for Avx512 {
    type F = __m512;
    type M = __mmask16;

    #[inline(always)]
    fn splat(self, x: f32) -> __m512 {
        with_avx512!(_mm512_set1_ps(x))
    }
    #[inline(always)]
    fn load(self, x: &[f32; 16]) -> __m512 {
        with_avx512!(_mm512_loadu_ps(x.as_ptr()))
    }
    #[inline(always)]
    fn store(self, x: __m512, to: &mut [f32; 16]) {
        with_avx512!(_mm512_storeu_ps(to.as_mut_ptr(), x))
    }
    #[inline(always)]
    fn load_4x4(self, from: &[f32], at: usize, stride: usize) -> __m512 {
        let from = &from[at..at + 3 * stride + 4];
        with_avx512!({
            let p = from.as_ptr();
            let x = _mm512_castps128_ps512(_mm_loadu_ps(p));
            let x = _mm512_insertf32x4::<1>(x, _mm_loadu_ps(p.add(stride)));
            let x = _mm512_insertf32x4::<2>(x, _mm_loadu_ps(p.add(2 * stride)));
            _mm512_insertf32x4::<3>(x, _mm_loadu_ps(p.add(3 * stride)))
        })
    }
    #[inline(always)]
    fn store_4x4(self, x: __m512, to: &mut [f32], at: usize, stride: usize) {
        let to = &mut to[at..at + 3 * stride + 4];
        with_avx512!({
            let p = to.as_mut_ptr();
            _mm_storeu_ps(p, _mm512_castps512_ps128(x));
            _mm_storeu_ps(p.add(stride), _mm512_extractf32x4_ps::<1>(x));
            _mm_storeu_ps(p.add(2 * stride), _mm512_extractf32x4_ps::<2>(x));
            _mm_storeu_ps(p.add(3 * stride), _mm512_extractf32x4_ps::<3>(x));
        })
    }
    #[inline(always)]
    fn add(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_add_ps(a, b))
    }
    #[inline(always)]
    fn sub(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_sub_ps(a, b))
    }
    #[inline(always)]
    fn mul(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_mul_ps(a, b))
    }
    #[inline(always)]
    fn div(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_div_ps(a, b))
    }
    #[inline(always)]
    fn fma(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        with_avx512!(_mm512_fmadd_ps(a, b, c))
    }
    #[inline(always)]
    fn fnma(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        with_avx512!(_mm512_fnmadd_ps(a, b, c))
    }
    #[inline(always)]
    fn min(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_min_ps(a, b))
    }
    #[inline(always)]
    fn max(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_max_ps(a, b))
    }
    #[inline(always)]
    fn sqrt(self, a: __m512) -> __m512 {
        with_avx512!(_mm512_sqrt_ps(a))
    }
    #[inline(always)]
    fn reciprocal_14(self, a: __m512) -> __m512 {
        with_avx512!(_mm512_rcp14_ps(a))
    }
    #[inline(always)]
    fn abs(self, a: __m512) -> __m512 {
        with_avx512!(_mm512_abs_ps(a))
    }
    #[inline(always)]
    fn floor(self, a: __m512) -> __m512 {
        with_avx512!(_mm512_roundscale_ps::<0x09>(a))
    }
    #[inline(always)]
    fn pack_u16(self, a: __m512, b: __m512) -> __m512 {
        with_avx512!({
            let high = _mm512_slli_epi32::<16>(_mm512_cvttps_epi32(b));
            _mm512_castsi512_ps(_mm512_or_si512(_mm512_cvttps_epi32(a), high))
        })
    }
    #[inline(always)]
    fn ge(self, a: __m512, b: __m512) -> __mmask16 {
        with_avx512!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(a, b))
    }
    #[inline(always)]
    fn gt(self, a: __m512, b: __m512) -> __mmask16 {
        with_avx512!(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, b))
    }
    #[inline(always)]
    fn and(self, a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    fn bits(self, m: __mmask16) -> u16 {
        m
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> __mmask16 {
        bits
    }
    #[inline(always)]
    fn select(self, m: __mmask16, a: __m512, b: __m512) -> __m512 {
        with_avx512!(_mm512_mask_blend_ps(m, b, a))
    }
    #[inline(always)]
    fn keep(self, m: __mmask16, a: __m512) -> __m512 {
        with_avx512!(_mm512_maskz_mov_ps(m, a))
    }
    #[inline(always)]
    fn exp2_split(self, x: __m512) -> (__m512, __m512) {
        // Rounding mode 1 is toward minus infinity, which is what the scale instruction does with n.
        with_avx512!((_mm512_reduce_ps::<1>(x), x))
    }
    #[inline(always)]
    fn exp2_scale(self, p: __m512, n: __m512) -> __m512 {
        with_avx512!(_mm512_scalef_ps(p, n))
    }
    #[inline(always)]
    fn exponent_mantissa(self, x: __m512) -> (__m512, __m512) {
        with_avx512!((_mm512_getexp_ps(x), _mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_ZERO>(x)))
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [__m512; 16]) {
        with_avx512!({
            // 4x4 transposes inside the 128-bit lanes of each group of four rows, then a transpose of the lanes.
            let mut t = *rows;
            for g in 0..4 {
                let (a, b, c, d) = (rows[4 * g], rows[4 * g + 1], rows[4 * g + 2], rows[4 * g + 3]);
                let ab_low = _mm512_castps_pd(_mm512_unpacklo_ps(a, b));
                let ab_high = _mm512_castps_pd(_mm512_unpackhi_ps(a, b));
                let cd_low = _mm512_castps_pd(_mm512_unpacklo_ps(c, d));
                let cd_high = _mm512_castps_pd(_mm512_unpackhi_ps(c, d));
                t[4 * g] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab_low, cd_low));
                t[4 * g + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab_low, cd_low));
                t[4 * g + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(ab_high, cd_high));
                t[4 * g + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(ab_high, cd_high));
            }
            for k in 0..4 {
                let (x, y, z, w) = (t[k], t[4 + k], t[8 + k], t[12 + k]);
                let xy_even = _mm512_shuffle_f32x4::<0x88>(x, y);
                let xy_odd = _mm512_shuffle_f32x4::<0xdd>(x, y);
                let zw_even = _mm512_shuffle_f32x4::<0x88>(z, w);
                let zw_odd = _mm512_shuffle_f32x4::<0xdd>(z, w);
                rows[k] = _mm512_shuffle_f32x4::<0x88>(xy_even, zw_even);
                rows[8 + k] = _mm512_shuffle_f32x4::<0xdd>(xy_even, zw_even);
                rows[4 + k] = _mm512_shuffle_f32x4::<0x88>(xy_odd, zw_odd);
                rows[12 + k] = _mm512_shuffle_f32x4::<0xdd>(xy_odd, zw_odd);
            }
        })
    }
    #[inline(always)]
    fn splat_four(self, x: [f32; 4]) -> __m512 {
        with_avx512!(_mm512_broadcast_f32x4(_mm_setr_ps(x[0], x[1], x[2], x[3])))
    }
    #[inline(always)]
    fn transpose_groups(self, x: [__m512; 4]) -> [__m512; 4] {
        with_avx512!({
            let ab_low = _mm512_castps_pd(_mm512_unpacklo_ps(x[0], x[1]));
            let ab_high = _mm512_castps_pd(_mm512_unpackhi_ps(x[0], x[1]));
            let cd_low = _mm512_castps_pd(_mm512_unpacklo_ps(x[2], x[3]));
            let cd_high = _mm512_castps_pd(_mm512_unpackhi_ps(x[2], x[3]));
            [
                _mm512_castpd_ps(_mm512_unpacklo_pd(ab_low, cd_low)),
                _mm512_castpd_ps(_mm512_unpackhi_pd(ab_low, cd_low)),
                _mm512_castpd_ps(_mm512_unpacklo_pd(ab_high, cd_high)),
                _mm512_castpd_ps(_mm512_unpackhi_pd(ab_high, cd_high)),
            ]
        })
    }
    #[inline(always)]
    fn sum_groups(self, x: [__m512; 4]) -> __m512 {
        lanes(self, lanes(self, x[0], x[1]), lanes(self, x[2], x[3]))
    }
    #[inline(always)]
    fn rows_of_groups(self, x: [__m512; 3]) -> [__m512; 4] {
        with_avx512!({
            // Groups become rows inside each vector, then rows of the three vectors come together.
            let turn = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
            let x0 = _mm512_permutexvar_ps(turn, x[0]);
            let x1 = _mm512_permutexvar_ps(turn, x[1]);
            let x2 = _mm512_permutexvar_ps(turn, x[2]);
            let zero = _mm512_setzero_ps();
            let (even, odd) = (_mm512_shuffle_f32x4::<0x88>(x0, x1), _mm512_shuffle_f32x4::<0xdd>(x0, x1));
            let (even2, odd2) = (_mm512_shuffle_f32x4::<0x88>(x2, zero), _mm512_shuffle_f32x4::<0xdd>(x2, zero));
            [
                _mm512_shuffle_f32x4::<0x88>(even, even2),
                _mm512_shuffle_f32x4::<0x88>(odd, odd2),
                _mm512_shuffle_f32x4::<0xdd>(even, even2),
                _mm512_shuffle_f32x4::<0xdd>(odd, odd2),
            ]
        })
    }
    #[inline(always)]
    fn append(self, mask: __mmask16, first: u16, to: &mut [u16]) -> usize {
        let to = &mut to[..16];
        with_avx512!({
            let counting = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            let numbers = _mm512_add_epi32(_mm512_set1_epi32(i32::from(first)), counting);
            let packed = _mm512_cvtepi32_epi16(_mm512_maskz_compress_epi32(mask, numbers));
            _mm256_storeu_si256(to.as_mut_ptr().cast(), packed);
        });
        mask.count_ones() as usize
    }
}
