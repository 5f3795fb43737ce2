//! Stacks that `perf script` prints: a line of the thread, a line for each frame from the innermost out, an empty line.

use std::collections::BTreeMap;

/// How often each stack was seen. Frames go from the thread inwards.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Stacks(BTreeMap<Vec<String>, u64>);

impl Stacks {
    pub fn samples(&self) -> u64 {
        self.0.values().sum()
    }

    pub fn iter(&self) -> impl Iterator<Item = (&[String], u64)> {
        self.0.iter().map(|(stack, &count)| (stack.as_slice(), count))
    }

    /// Innermost functions, those that were seen most first.
    pub fn leaves(&self) -> Vec<(&str, u64)> {
        let mut leaves: BTreeMap<&str, u64> = BTreeMap::new();
        for (stack, count) in &self.0 {
            if let Some(leaf) = stack.last() {
                *leaves.entry(leaf).or_default() += count;
            }
        }
        let mut leaves: Vec<(&str, u64)> = leaves.into_iter().collect();
        leaves.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(b.0)));
        leaves
    }
}

pub(super) fn read(script: &str) -> Stacks {
    let mut stacks = Stacks::default();
    for sample in script.split("\n\n") {
        let mut lines = sample.lines().filter(|line| !line.trim().is_empty());
        let Some(thread) = lines.next().and_then(thread_of) else { continue };
        let mut frames: Vec<String> = lines.filter_map(function_of).collect();
        frames.push(thread);
        frames.reverse();
        *stacks.0.entry(frames).or_default() += 1;
    }
    stacks
}

/// `train  2889 ` is the thread `train`; its name may hold spaces.
fn thread_of(line: &str) -> Option<String> {
    if line.starts_with(char::is_whitespace) {
        return None;
    }
    let (name, id) = line.trim_end().rsplit_once(char::is_whitespace)?;
    id.chars().all(|c| c.is_ascii_digit()).then(|| name.trim_end().to_owned())
}

/// `    f8350 __GI___libc_write` is the function `__GI___libc_write`; without the hash that makes Rust's names unique.
fn function_of(line: &str) -> Option<String> {
    let (_, name) = line.trim().split_once(char::is_whitespace)?;
    let name = name.trim();
    let plain = match name.rsplit_once("::h") {
        Some((before, hash)) if hash.len() == 16 && hash.chars().all(|c| c.is_ascii_hexdigit()) => before,
        _ => name,
    };
    Some(plain.to_owned())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn stacks_are_counted_by_thread_and_function() {
        let script = "train  2889 \n\t           f8350 splatting::blend::h0123456789abcdef\n\t    22 main\n\n\
                      train  2889 \n\t           f8350 splatting::blend::h0123456789abcdef\n\t    22 main\n\n\
                      a thread  2890 \n\t            2aac [unknown]\n\n";
        let stacks = read(script);
        let all: Vec<(Vec<&str>, u64)> =
            stacks.iter().map(|(stack, count)| (stack.iter().map(String::as_str).collect(), count)).collect();
        assert_eq!(all, [(vec!["a thread", "[unknown]"], 1), (vec!["train", "main", "splatting::blend"], 2)]);
        assert_eq!((stacks.samples(), stacks.leaves()[0]), (3, ("splatting::blend", 2)));
    }

    proptest! {
        #[test]
        fn whatever_perf_prints_is_read(script in "[a-z0-9:\\[\\] \t\n]{0,400}") {
            let stacks = read(&script);
            prop_assert!(stacks.iter().all(|(stack, count)| !stack.is_empty() && count > 0));
        }
    }
}
