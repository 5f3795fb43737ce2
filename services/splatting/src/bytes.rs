//! Numbers to bytes and back, little-endian, for checkpoints. Reading never trusts the bytes: a length is checked against
//! what is left before anything is reserved.

/// Bytes end before what should follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("ends at byte {at}, in the middle of {what}")]
pub struct Truncated {
    /// Where the bytes end.
    pub at: usize,
    /// What was being read.
    pub what: &'static str,
}

/// Appends numbers.
#[derive(Debug, Default)]
pub struct Writer {
    bytes: Vec<u8>,
}

impl Writer {
    /// What was written.
    #[must_use]
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends a byte string with its length.
    pub fn blob(&mut self, bytes: &[u8]) {
        self.u64(bytes.len() as u64);
        self.bytes.extend_from_slice(bytes);
    }

    /// Appends a list with its length.
    pub fn list<T>(&mut self, items: impl ExactSizeIterator<Item = T>, mut write: impl FnMut(&mut Self, T)) {
        self.u64(items.len() as u64);
        items.for_each(|item| write(self, item));
    }
}

/// Reads numbers.
#[derive(Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    /// Reads from the beginning of some bytes.
    #[must_use]
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// Bytes not yet read.
    #[must_use]
    pub fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn take(&mut self, length: usize, what: &'static str) -> Result<&'a [u8], Truncated> {
        let end = self.at.checked_add(length).filter(|&end| end <= self.bytes.len());
        let Some(end) = end else { return Err(Truncated { at: self.bytes.len(), what }) };
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }

    /// Reads a number of bytes.
    ///
    /// # Errors
    /// Where the bytes end.
    pub fn bytes(&mut self, length: usize, what: &'static str) -> Result<&'a [u8], Truncated> {
        self.take(length, what)
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], Truncated> {
        self.take(N, what)?.try_into().map_err(|_wrong_length| Truncated { at: self.at, what })
    }

    /// Reads a byte string.
    ///
    /// # Errors
    /// Where the bytes end.
    pub fn blob(&mut self, what: &'static str) -> Result<&'a [u8], Truncated> {
        let length = usize::try_from(self.u64(what)?).unwrap_or(usize::MAX);
        self.take(length, what)
    }

    /// Reads a list whose items take at least `least_bytes` each.
    ///
    /// # Errors
    /// Where the bytes end, or are too few for the length that they give.
    pub fn list<T>(
        &mut self,
        what: &'static str,
        least_bytes: usize,
        mut read: impl FnMut(&mut Self) -> Result<T, Truncated>,
    ) -> Result<Vec<T>, Truncated> {
        let length = usize::try_from(self.u64(what)?).unwrap_or(usize::MAX);
        if length > self.left() / least_bytes.max(1) {
            return Err(Truncated { at: self.bytes.len(), what });
        }
        (0..length).map(|_| read(self)).collect()
    }
}

macro_rules! numbers {
    ($($name:ident),*) => {
        impl Writer { $(
            /// Appends a number.
            pub fn $name(&mut self, value: $name) {
                self.bytes.extend_from_slice(&value.to_le_bytes());
            }
        )* }
        impl Reader<'_> { $(
            /// Reads a number.
            ///
            /// # Errors
            /// Where the bytes end.
            pub fn $name(&mut self, what: &'static str) -> Result<$name, Truncated> {
                Ok($name::from_le_bytes(self.array(what)?))
            }
        )* }
    };
}
numbers!(u32, u64, i32, f32, f64);

/// Checksum of bytes (FNV-1a over 8-byte words, then the rest): tells a torn or rotten file from a whole one.
#[must_use]
pub fn checksum(bytes: &[u8]) -> u64 {
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let chunks = bytes.chunks_exact(8);
    let rest = chunks.remainder();
    let fold = |hash: u64, word: u64| (hash ^ word).wrapping_mul(PRIME).rotate_left(23);
    let hash = chunks.fold(0xcbf2_9ce4_8422_2325 ^ bytes.len() as u64, |hash, word| {
        fold(hash, word.try_into().map_or(0, u64::from_le_bytes))
    });
    rest.iter().fold(hash, |hash, &byte| fold(hash, u64::from(byte)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_lists_and_blobs_come_back() {
        let mut writer = Writer::default();
        writer.u64(7);
        writer.f64(-0.5);
        writer.list([1i32, -2, 3].iter(), |w, &x| w.i32(x));
        writer.blob(b"abc");
        let bytes = writer.into_bytes();
        let mut reader = Reader::new(&bytes);
        assert_eq!(reader.u64("a"), Ok(7));
        assert_eq!(reader.f64("b"), Ok(-0.5));
        assert_eq!(reader.list("c", 4, |r| r.i32("item")), Ok(vec![1, -2, 3]));
        assert_eq!(reader.blob("d"), Ok(&b"abc"[..]));
        assert_eq!(reader.left(), 0);
        assert_eq!(reader.u32("more"), Err(Truncated { at: bytes.len(), what: "more" }));
    }

    #[test]
    fn a_length_beyond_the_bytes_reserves_nothing() {
        let mut writer = Writer::default();
        writer.u64(u64::MAX);
        let bytes = writer.into_bytes();
        assert!(Reader::new(&bytes).blob("x").is_err());
        assert!(Reader::new(&bytes).list("x", 4, |r| r.u32("y")).is_err());
    }

    proptest::proptest! {
        #[test]
        fn one_flipped_bit_changes_the_checksum(
            bytes in proptest::collection::vec(0u8..=255, 1..200), at in 0usize..1600
        ) {
            let mut flipped = bytes.clone();
            flipped[at / 8 % bytes.len()] ^= 1 << (at % 8);
            proptest::prop_assert_ne!(checksum(&bytes), checksum(&flipped));
        }
    }
}
