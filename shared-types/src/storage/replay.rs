//! A loss of power at any place of a recorded trace: what may then be on the disk.
//!
//! The model is that of a file system which promises what POSIX says of `fsync` and no more. Bytes that were synced are
//! there. Of those written since, all may be there, a part, or none; blocks that are not there read as zeros where later
//! ones are. A name that was made, changed or removed since its folder was synced may have the one meaning or the other,
//! whatever became of the bytes of its file: a renamed file whose bytes were not synced may be empty. A rename is whole.

use std::collections::{BTreeMap, HashSet};
use std::ffi::OsString;
use std::fs;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::io;
use std::path::{Path, PathBuf};

use super::record::{Op, Trace, Tree};

/// Files below this are cut at every byte, larger ones at [`PLACES`].
const SMALL_BYTES: usize = 64 << 10;
/// Random places at which writes to large files are cut.
const PLACES: usize = 200;
/// What a disk writes at once.
const BLOCK_BYTES: usize = 4096;
/// Drawn outcomes at each operation.
const DRAWS: u64 = 8;

/// What became of everything that was not synced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Lost,
    There,
    /// Each name and each block for itself, by this seed.
    Drawn(u64),
}

/// A place at which the power was cut, and what was found after it.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// What is on the disk.
    pub tree: Tree,
    /// Where and how, for a message.
    pub place: String,
}

/// What was found over all outcomes of a trace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Findings {
    /// Places at which the power was cut, fates of what was not synced counted once each.
    pub places: usize,
    /// Outcomes that differ.
    pub distinct: usize,
    /// Distinct outcomes by what their reader called them.
    pub by_name: BTreeMap<&'static str, usize>,
}

/// SplitMix64: the same places and fates each time.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % (n.max(1) as u64)).unwrap_or(0)
    }
}

#[derive(Debug, Clone)]
enum Data {
    Write { at: usize, bytes: Vec<u8> },
    Cut(usize),
}

#[derive(Debug, Clone)]
enum Node {
    File { durable: Vec<u8>, pending: Vec<Data>, len: usize },
    Dir { durable: Names, live: Names, pending: Vec<Vec<(OsString, Option<usize>)>> },
}

type Names = BTreeMap<OsString, usize>;

/// The disk and what the memory holds back, after some operations. Node 0 is the folder.
#[derive(Debug)]
struct Machine {
    nodes: Vec<Node>,
    open: BTreeMap<usize, usize>,
}

impl Machine {
    fn new(before: &Tree) -> Self {
        let mut machine = Self { nodes: vec![Self::dir()], open: BTreeMap::new() };
        for (path, content) in before {
            let node = match content {
                Some(bytes) => Node::File { durable: bytes.clone(), pending: Vec::new(), len: bytes.len() },
                None => Self::dir(),
            };
            machine.add(path, node);
        }
        for node in &mut machine.nodes {
            if let Node::Dir { durable, live, pending } = node {
                durable.clone_from(live);
                pending.clear();
            }
        }
        machine
    }

    fn dir() -> Node {
        Node::Dir { durable: Names::new(), live: Names::new(), pending: Vec::new() }
    }

    fn find(&self, path: &Path) -> Option<usize> {
        path.components().try_fold(0, |at, part| match self.nodes.get(at) {
            Some(Node::Dir { live, .. }) => live.get(part.as_os_str()).copied(),
            _ => None,
        })
    }

    /// Changes names of one folder, all at once.
    fn name(&mut self, folder: &Path, changes: Vec<(OsString, Option<usize>)>) {
        let Some(at) = self.find(folder) else { return };
        if let Some(Node::Dir { live, pending, .. }) = self.nodes.get_mut(at) {
            apply(live, &changes);
            pending.push(changes);
        }
    }

    fn add(&mut self, path: &Path, node: Node) -> usize {
        let number = self.nodes.len();
        self.nodes.push(node);
        self.name(parent(path), vec![(last(path), Some(number))]);
        number
    }

    fn step(&mut self, op: &Op) {
        match op {
            Op::CreateDir(path) => {
                self.add(path, Self::dir());
            }
            Op::Open(file, path) => {
                let node = self
                    .find(path)
                    .unwrap_or_else(|| self.add(path, Node::File { durable: Vec::new(), pending: Vec::new(), len: 0 }));
                self.open.insert(*file, node);
            }
            Op::Write(file, bytes) => {
                if let Some(Node::File { pending, len, .. }) = self.file(*file) {
                    pending.push(Data::Write { at: *len, bytes: bytes.clone() });
                    *len += bytes.len();
                }
            }
            Op::Cut(file, to) => {
                if let Some(Node::File { pending, len, .. }) = self.file(*file) {
                    pending.push(Data::Cut(*to));
                    *len = *to;
                }
            }
            Op::Sync(file) => {
                if let Some(Node::File { durable, pending, .. }) = self.file(*file) {
                    let content = bytes_of(durable, pending, None, Fate::There);
                    *durable = content;
                    pending.clear();
                }
            }
            Op::Rename(from, to) => {
                let moved = self.find(from);
                self.name(parent(from), vec![(last(from), None), (last(to), moved)]);
            }
            Op::Exchange(one, other) => {
                let (first, second) = (self.find(one), self.find(other));
                self.name(parent(one), vec![(last(one), second), (last(other), first)]);
            }
            Op::Remove(path) => self.name(parent(path), vec![(last(path), None)]),
            Op::SyncDir(path) => {
                let at = self.find(path);
                if let Some(Node::Dir { durable, live, pending }) = at.and_then(|at| self.nodes.get_mut(at)) {
                    durable.clone_from(live);
                    pending.clear();
                }
            }
        }
    }

    fn file(&mut self, file: usize) -> Option<&mut Node> {
        let node = *self.open.get(&file)?;
        self.nodes.get_mut(node)
    }

    /// What is found, where a last write had come as far as `partial`.
    fn outcome(&self, partial: Option<(usize, &[u8])>, names: Fate, data: Fate) -> Tree {
        let partial = partial.and_then(|(file, bytes)| Some((*self.open.get(&file)?, bytes)));
        let mut tree = Tree::new();
        self.collect(0, Path::new(""), partial, names, data, &mut tree);
        tree
    }

    fn collect(
        &self,
        at: usize,
        path: &Path,
        partial: Option<(usize, &[u8])>,
        names: Fate,
        data: Fate,
        tree: &mut Tree,
    ) {
        match &self.nodes[at] {
            Node::File { durable, pending, len } => {
                let partial = partial.filter(|(node, _)| *node == at).map(|(_, bytes)| (*len, bytes));
                tree.insert(path.to_owned(), Some(bytes_of(durable, pending, partial, mixed(data, at))));
            }
            Node::Dir { durable, live, pending } => {
                if at != 0 {
                    tree.insert(path.to_owned(), None);
                }
                let found = match mixed(names, at) {
                    Fate::Lost => durable.clone(),
                    Fate::There => live.clone(),
                    Fate::Drawn(seed) => {
                        let (mut found, mut random) = (durable.clone(), Random(seed));
                        // Of a journal, all up to some change; else each for itself.
                        let up_to = (random.next() % 2 == 0).then(|| random.below(pending.len() + 1));
                        for (number, changes) in pending.iter().enumerate() {
                            if up_to.map_or_else(|| random.next() % 2 == 0, |up_to| number < up_to) {
                                apply(&mut found, changes);
                            }
                        }
                        found
                    }
                };
                for (name, node) in found {
                    self.collect(node, &path.join(after_reboot(&name)), partial, names, data, tree);
                }
            }
        }
    }
}

fn parent(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

fn last(path: &Path) -> OsString {
    path.file_name().unwrap_or_default().to_owned()
}

/// A name aside carries its writer's process and start: after a reboot, this process is not that one.
fn after_reboot(name: &OsString) -> OsString {
    let own = format!(".tmp-{}-", std::process::id());
    match name.to_str().and_then(|text| text.strip_prefix(&own)?.split_once('-')) {
        Some((_start, rest)) => OsString::from(format!("{own}1-{rest}")),
        None => name.clone(),
    }
}

fn apply(names: &mut Names, changes: &[(OsString, Option<usize>)]) {
    for (name, node) in changes {
        match node {
            Some(node) => names.insert(name.clone(), *node),
            None => names.remove(name),
        };
    }
}

/// The fate of one node: each draws for itself.
fn mixed(fate: Fate, node: usize) -> Fate {
    match fate {
        Fate::Drawn(seed) => Fate::Drawn(Random(seed ^ (node as u64) << 32).next()),
        other => other,
    }
}

fn bytes_of(durable: &[u8], pending: &[Data], partial: Option<(usize, &[u8])>, fate: Fate) -> Vec<u8> {
    let mut content = durable.to_vec();
    if fate == Fate::Lost {
        return content;
    }
    let mut random = match fate {
        Fate::Drawn(seed) => Some(Random(seed)),
        _ => None,
    };
    for change in pending {
        match change {
            Data::Cut(len) => {
                if random.as_mut().is_none_or(|random| random.next() % 2 == 0) {
                    content.truncate(*len);
                }
            }
            Data::Write { at, bytes } => put(&mut content, *at, bytes, random.as_mut()),
        }
    }
    if let Some((at, bytes)) = partial {
        put(&mut content, at, bytes, random.as_mut());
    }
    content
}

/// Puts bytes into a file: all of them, or what a draw leaves: a beginning, or each block for itself.
fn put(content: &mut Vec<u8>, at: usize, bytes: &[u8], random: Option<&mut Random>) {
    let mut write = |from: usize, part: &[u8]| {
        let end = from + part.len();
        if content.len() < end {
            content.resize(end, 0);
        }
        content[from..end].copy_from_slice(part);
    };
    let Some(random) = random else {
        write(at, bytes);
        return;
    };
    if random.next() % 2 == 0 {
        write(at, &bytes[..random.below(bytes.len() + 1)]);
        return;
    }
    let mut from = 0;
    while from < bytes.len() {
        let end = (from + BLOCK_BYTES - (at + from) % BLOCK_BYTES).min(bytes.len());
        if random.next() % 2 == 0 {
            write(at + from, &bytes[from..end]);
        }
        from = end;
    }
}

/// The largest size of each file of a trace, as it is numbered there.
fn sizes(trace: &Trace) -> BTreeMap<usize, usize> {
    let mut sizes = BTreeMap::new();
    let mut machine = Machine::new(&trace.before);
    for op in &trace.ops {
        machine.step(op);
        if let Op::Open(file, _) | Op::Write(file, _) = op
            && let Some(Node::File { len, .. }) = machine.file(*file)
        {
            let len = *len;
            let size = sizes.entry(*file).or_insert(0);
            *size = len.max(*size);
        }
    }
    sizes
}

/// Places within the writes of a trace, as (operation, bytes of it): every byte of small files, and [`PLACES`] in all
/// others.
fn places(trace: &Trace, is_large: impl Fn(&usize) -> bool) -> BTreeMap<usize, Vec<usize>> {
    let mut places: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    let mut large = Vec::new();
    for (number, op) in trace.ops.iter().enumerate() {
        let Op::Write(file, bytes) = op else { continue };
        if is_large(file) {
            large.push((number, bytes.len()));
        } else {
            places.insert(number, (1..bytes.len()).collect());
        }
    }
    let total: usize = large.iter().map(|(_, len)| len).sum();
    let mut random = Random(1);
    for _ in 0..if total > 0 { PLACES } else { 0 } {
        let mut at = random.below(total);
        for (number, len) in &large {
            if at < *len {
                places.entry(*number).or_default().push(at.max(1));
                break;
            }
            at -= len;
        }
    }
    places
}

/// Cuts the power at every operation of a trace and within its writes, and shows each outcome that differs from those
/// before it.
///
/// # Errors
/// The first error of `show`.
pub fn outcomes<E>(trace: &Trace, mut show: impl FnMut(&Outcome) -> Result<(), E>) -> Result<Findings, E> {
    let sizes = sizes(trace);
    let is_large = |file: &usize| sizes.get(file).is_some_and(|size| *size >= SMALL_BYTES);
    let places = places(trace, is_large);
    let mut findings = Findings::default();
    let mut seen = HashSet::new();
    let mut machine = Machine::new(&trace.before);
    for number in 0..=trace.ops.len() {
        let done = if number == 0 { "nothing".to_owned() } else { described(&trace.ops[number - 1]) };
        let mut shown = |machine: &Machine, partial: Option<(usize, &[u8])>, names: Fate, data: Fate| {
            findings.places += 1;
            let tree = machine.outcome(partial, names, data);
            let mut hasher = DefaultHasher::new();
            tree.hash(&mut hasher);
            if !seen.insert(hasher.finish()) {
                return Ok(());
            }
            findings.distinct += 1;
            let within = partial.map_or_else(String::new, |(_, bytes)| format!(" and {} bytes more", bytes.len()));
            let place = format!("after operation {number} ({done}){within}: names {names:?}, data {data:?}");
            show(&Outcome { tree, place })
        };
        for (names, data) in
            [(Fate::Lost, Fate::Lost), (Fate::There, Fate::There), (Fate::There, Fate::Lost), (Fate::Lost, Fate::There)]
        {
            shown(&machine, None, names, data)?;
        }
        for draw in 0..DRAWS {
            let seed = Random(number as u64 * DRAWS + draw).next();
            shown(&machine, None, Fate::There, Fate::Drawn(seed))?;
            shown(&machine, None, Fate::Drawn(seed), Fate::Drawn(seed))?;
        }
        let Some(op) = trace.ops.get(number) else { break };
        if let (Op::Write(file, bytes), Some(places)) = (op, places.get(&number)) {
            for &place in places {
                let partial = Some((*file, &bytes[..place]));
                shown(&machine, partial, Fate::There, Fate::There)?;
                if is_large(file) {
                    shown(&machine, partial, Fate::There, Fate::Drawn(Random(place as u64).next()))?;
                }
            }
        }
        machine.step(op);
    }
    Ok(findings)
}

fn described(op: &Op) -> String {
    match op {
        Op::Write(file, bytes) => format!("Write({file}, {} bytes)", bytes.len()),
        other => format!("{other:?}"),
    }
}

/// Puts a tree into an empty folder.
///
/// # Errors
/// When something cannot be written.
pub fn write_tree(tree: &Tree, folder: &Path) -> io::Result<()> {
    for (path, content) in tree {
        let path: PathBuf = folder.join(path);
        match content {
            Some(bytes) => fs::write(path, bytes)?,
            None => fs::create_dir(path)?,
        }
    }
    Ok(())
}

/// Cuts the power everywhere, and lets the product read what is left: `read` is given a folder that lies at `root` (made
/// and removed for each outcome) and names what it found there, or says what is wrong.
///
/// # Errors
/// What `read` said, with the place of the cut.
pub fn every_outcome(
    trace: &Trace,
    root: &Path,
    mut read: impl FnMut(&Path) -> Result<&'static str, String>,
) -> Result<Findings, String> {
    let mut by_name = BTreeMap::new();
    let findings = outcomes(trace, |outcome| {
        let disk = |error: io::Error| format!("{}: {error}", root.display());
        fs::create_dir(root).and_then(|()| write_tree(&outcome.tree, root)).map_err(disk)?;
        let name = read(root).map_err(|why| {
            let files: Vec<String> = outcome
                .tree
                .iter()
                .map(|(path, content)| format!("{} ({:?} bytes)", path.display(), content.as_ref().map(Vec::len)))
                .collect();
            format!("{}\n{why}\non the disk: {}", outcome.place, files.join(", "))
        })?;
        *by_name.entry(name).or_insert(0) += 1;
        fs::remove_dir_all(root).map_err(disk)
    })?;
    Ok(Findings { by_name, ..findings })
}
