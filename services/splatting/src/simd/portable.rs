//! Plain Rust, for machines without AVX2 and as a second opinion in tests. No `mul_add`, `floor` or `round`: without
//! the instructions they are library calls.

use super::Simd;

#[derive(Clone, Copy)]
pub(super) struct Portable;

type F16 = [f32; 16];

#[inline(always)]
fn zip(a: F16, b: F16, f: impl Fn(f32, f32) -> f32) -> F16 {
    std::array::from_fn(|i| f(a[i], b[i]))
}

#[inline(always)]
fn compare(a: F16, b: F16, f: impl Fn(f32, f32) -> bool) -> u16 {
    (0..16).fold(0, |bits, i| bits | u16::from(f(a[i], b[i])) << i)
}

impl Simd for Portable {
    type F = F16;
    type M = u16;

    #[inline(always)]
    fn splat(self, x: f32) -> F16 {
        [x; 16]
    }
    #[inline(always)]
    fn load(self, x: &[f32; 16]) -> F16 {
        *x
    }
    #[inline(always)]
    fn store(self, x: F16, to: &mut [f32; 16]) {
        *to = x;
    }
    #[inline(always)]
    fn load_4x4(self, from: &[f32], at: usize, stride: usize) -> F16 {
        std::array::from_fn(|i| from[at + i / 4 * stride + i % 4])
    }
    #[inline(always)]
    fn store_4x4(self, x: F16, to: &mut [f32], at: usize, stride: usize) {
        for (i, x) in x.into_iter().enumerate() {
            to[at + i / 4 * stride + i % 4] = x;
        }
    }
    #[inline(always)]
    fn add(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    fn fma(self, a: F16, b: F16, c: F16) -> F16 {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn fnma(self, a: F16, b: F16, c: F16) -> F16 {
        std::array::from_fn(|i| c[i] - a[i] * b[i])
    }
    #[inline(always)]
    fn min(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn sqrt(self, a: F16) -> F16 {
        a.map(f32::sqrt)
    }
    #[inline(always)]
    fn reciprocal_14(self, a: F16) -> F16 {
        a.map(f32::recip)
    }
    #[inline(always)]
    fn abs(self, a: F16) -> F16 {
        a.map(f32::abs)
    }
    #[inline(always)]
    fn floor(self, a: F16) -> F16 {
        // Without SSE 4.1 the standard library's is a call.
        a.map(|a| {
            let towards_zero = a as i32 as f32;
            if towards_zero > a { towards_zero - 1.0 } else { towards_zero }
        })
    }
    #[inline(always)]
    fn pack_u16(self, a: F16, b: F16) -> F16 {
        zip(a, b, |a, b| f32::from_bits(a as u32 | (b as u32) << 16))
    }
    #[inline(always)]
    fn ge(self, a: F16, b: F16) -> u16 {
        compare(a, b, |a, b| a >= b)
    }
    #[inline(always)]
    fn gt(self, a: F16, b: F16) -> u16 {
        compare(a, b, |a, b| a > b)
    }
    #[inline(always)]
    fn and(self, a: u16, b: u16) -> u16 {
        a & b
    }
    #[inline(always)]
    fn bits(self, m: u16) -> u16 {
        m
    }
    #[inline(always)]
    fn mask(self, bits: u16) -> u16 {
        bits
    }
    #[inline(always)]
    fn select(self, m: u16, a: F16, b: F16) -> F16 {
        std::array::from_fn(|i| if m >> i & 1 == 1 { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn keep(self, m: u16, a: F16) -> F16 {
        std::array::from_fn(|i| if m >> i & 1 == 1 { a[i] } else { 0.0 })
    }
    #[inline(always)]
    fn exp2_split(self, x: F16) -> (F16, F16) {
        // The clamp keeps the exponent of the scale inside the normal range; below it the scale is made 0.
        let x = x.map(|x| if x > -127.0 { if x < 127.0 { x } else { 127.0 } } else { -127.0 });
        let n = x.map(|x| {
            let whole = x as i32 as f32;
            if whole > x { whole - 1.0 } else { whole }
        });
        (zip(x, n, |x, n| x - n), n)
    }
    #[inline(always)]
    fn exp2_scale(self, p: F16, n: F16) -> F16 {
        zip(p, n, |p, n| p * f32::from_bits((n as i32 + 127).max(0).cast_unsigned() << 23))
    }
    #[inline(always)]
    fn exponent_mantissa(self, x: F16) -> (F16, F16) {
        let bits = x.map(f32::to_bits);
        let e = bits.map(|b| (b >> 23 & 0xff) as f32 - 127.0);
        (e, bits.map(|b| f32::from_bits(b & 0x007f_ffff | 0x3f80_0000)))
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [F16; 16]) {
        *rows = std::array::from_fn(|i| std::array::from_fn(|j| rows[j][i]));
    }
}
