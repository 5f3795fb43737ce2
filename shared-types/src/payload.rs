//! Plain data that may lie in shared memory: the [`Payload`] trait, the macro that declares one, and the schema hash.
//!
//! iceoryx2 compares only the name, size and alignment of a payload: two structs with swapped fields open fine and are
//! misread. Every payload therefore carries a hash of its declaration (field names and, recursively, field types), which
//! each channel publishes as an attribute; processes that disagree refuse to talk.

use bytemuck::Pod;
use iceoryx2::prelude::ZeroCopySend;

use crate::describe::Describe;

/// Data without pointers, padding, enums, bools or options, laid out as C does, which another process may read in place.
///
/// Implemented by [`payload!`](crate::payload!) for structs, here for numbers and arrays of payloads.
pub trait Payload: Pod + ZeroCopySend + Describe + core::fmt::Debug + Send + Sync + 'static {
    /// Hash of the declaration, so that two processes can tell whether they mean the same bytes.
    const SCHEMA: u64;
}

/// Start value of [`fold_text`] and [`fold`]: the FNV-1a offset basis.
pub const SCHEMA_SEED: u64 = 0xcbf2_9ce4_8422_2325;
const FNV_PRIME: u64 = 0x0000_0100_0000_01b3;

/// Folds text into a schema hash (FNV-1a, 64 bits).
#[must_use]
pub const fn fold_text(mut hash: u64, text: &str) -> u64 {
    let bytes = text.as_bytes();
    let mut i = 0;
    while i < bytes.len() {
        hash = (hash ^ bytes[i] as u64).wrapping_mul(FNV_PRIME);
        i += 1;
    }
    hash
}

/// Folds another hash into a schema hash.
#[must_use]
pub const fn fold(hash: u64, other: u64) -> u64 {
    (hash ^ other).wrapping_mul(FNV_PRIME).rotate_left(29)
}

macro_rules! number_payloads {
    ($($number:ty),*) => { $(
        impl Payload for $number {
            const SCHEMA: u64 = fold_text(SCHEMA_SEED, stringify!($number));
        }
    )* };
}
number_payloads!(u8, u16, u32, u64, i32, i64, f32, f64);

impl<T: Payload, const N: usize> Payload for [T; N]
where
    [T; N]: Pod + ZeroCopySend,
{
    const SCHEMA: u64 = fold(fold(SCHEMA_SEED, T::SCHEMA), N as u64);
}

/// Declares a struct that may lie in shared memory: `repr(C)`, `Pod` (so a layout with padding does not compile), zero
/// by default, with a schema hash over its declaration. The size in bytes after the name is checked, so that nobody
/// changes what crosses processes without noticing.
#[macro_export]
macro_rules! payload {
    ($(#[$doc:meta])* pub struct $name:ident [$size:literal] { $( $(#[$field_doc:meta])* pub $field:ident : $kind:ty ),* $(,)? }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, PartialEq, $crate::private::Pod, $crate::private::Zeroable)]
        pub struct $name { $( $(#[$field_doc])* pub $field: $kind ),* }

        const _: () = assert!(
            core::mem::size_of::<$name>() == $size,
            concat!(stringify!($name), ": the size in bytes is not the declared one")
        );

        impl Default for $name {
            fn default() -> Self { <Self as $crate::private::Zeroable>::zeroed() }
        }

        #[expect(unsafe_code, reason = "shared memory needs the promise that the type holds no pointer")]
        // SAFETY: the type is `Pod`: `repr(C)`, without pointers, references, padding or drop glue.
        unsafe impl $crate::private::ZeroCopySend for $name {
            unsafe fn type_name() -> &'static str { stringify!($name) }
        }

        impl $crate::describe::Describe for $name {
            fn json(&self) -> $crate::private::Value {
                let mut fields = $crate::private::Map::new();
                $( $crate::private::tell(&mut fields, stringify!($field), &self.$field); )*
                $crate::private::Value::Object(fields)
            }

            fn schema() -> $crate::private::Value {
                let mut fields = $crate::private::Map::new();
                $( $crate::private::tell_schema::<$kind>(&mut fields, stringify!($field)); )*
                $crate::private::object_schema(stringify!($name), fields)
            }
        }

        impl $crate::Payload for $name {
            const SCHEMA: u64 = {
                let mut hash = $crate::private::fold_text($crate::private::SCHEMA_SEED, stringify!($name));
                $(
                    hash = $crate::private::fold_text(hash, stringify!($field));
                    hash = $crate::private::fold(hash, <$kind as $crate::Payload>::SCHEMA);
                )*
                hash
            };
        }
    };
}

/// Declares an enum that crosses processes as a `u32` code: the enum itself never lies in shared memory, since a wild
/// code would be undefined behaviour; `from_code` refuses it instead.
#[macro_export]
macro_rules! codes {
    ($(#[$doc:meta])* pub enum $name:ident { $( $(#[$variant_doc:meta])* $variant:ident = $code:literal, $text:literal ),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum $name { $( $(#[$variant_doc])* $variant ),* }

        impl $name {
            /// Every variant, in the order of their codes.
            pub const ALL: &'static [Self] = &[ $( Self::$variant ),* ];

            /// The number that stands for this variant in a payload.
            #[must_use]
            pub const fn code(self) -> u32 { match self { $( Self::$variant => $code ),* } }

            /// The variant of a code; `None` for a code that no variant has (a wild writer, another version).
            #[must_use]
            pub const fn from_code(code: u32) -> Option<Self> { match code { $( $code => Some(Self::$variant), )* _ => None } }

            /// The name for people and journals.
            #[must_use]
            pub const fn name(self) -> &'static str { match self { $( Self::$variant => $text ),* } }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result { f.write_str(self.name()) }
        }
    };
}

/// Packs text into a fixed field: UTF-8, zero-padded, cut at a character's border where it is too long.
#[must_use]
pub fn pack_text<const N: usize>(text: &str) -> [u8; N] {
    let mut packed = [0; N];
    let end = (0..=text.len().min(N)).rev().find(|&i| text.is_char_boundary(i)).unwrap_or(0);
    packed[..end].copy_from_slice(&text.as_bytes()[..end]);
    packed
}

/// Reads text from a fixed field up to its first zero byte; bytes that are not UTF-8 become U+FFFD.
#[must_use]
pub fn unpack_text(packed: &[u8]) -> String {
    let end = packed.iter().position(|&b| b == 0).unwrap_or(packed.len());
    String::from_utf8_lossy(&packed[..end]).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    payload! {
        /// Two numbers.
        pub struct Ab [8] { pub a: u32, pub b: u32 }
    }
    mod swapped {
        payload! {
            /// The same two, the other way round.
            pub struct Ab [8] { pub b: u32, pub a: u32 }
        }
    }
    mod retyped {
        payload! {
            /// The same names, another type of the same size.
            pub struct Ab [8] { pub a: u32, pub b: f32 }
        }
    }
    codes! {
        /// Colours.
        pub enum Colour { Red = 1, "red", Blue = 5, "blue" }
    }

    #[test]
    fn a_schema_changes_with_the_order_and_the_types_of_fields() {
        assert_ne!(Ab::SCHEMA, swapped::Ab::SCHEMA);
        assert_ne!(Ab::SCHEMA, retyped::Ab::SCHEMA);
        assert_ne!(<[u32; 3]>::SCHEMA, <[u32; 4]>::SCHEMA);
    }

    #[test]
    fn codes_go_both_ways_and_refuse_unknown_numbers() {
        for &colour in Colour::ALL {
            assert_eq!(Colour::from_code(colour.code()), Some(colour));
        }
        assert_eq!(Colour::from_code(2), None);
    }

    proptest::proptest! {
        #[test]
        fn text_survives_packing_or_is_cut_at_a_character(text in "[^\u{0}]{0,40}") {
            let packed: [u8; 32] = pack_text(&text);
            let back = unpack_text(&packed);
            proptest::prop_assert!(text.starts_with(&back));
            proptest::prop_assert!(back.len() > 28 || back == text);
        }
    }
}
