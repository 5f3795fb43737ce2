//! What a mission needs of this machine before it may take off: descriptors, memory, shared memory and disk space.

use std::path::Path;

use rustix::fs::statvfs;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use shared_types::bus::Limits;
use shared_types::channel::{Channel, ChannelVisitor, visit_all};
use shared_types::config::Config;
use shared_types::system::SHARED_MEMORY_DIR;

use crate::exit::Refusal;

/// Bytes of one Gaussian on the snapshot channel.
const GAUSSIAN_BYTES: u64 = size_of::<shared_types::messages::GaussianRow>() as u64;

/// What connections, service descriptions and the odd tool that looks in take besides, bytes.
const BESIDES_BYTES: u64 = 16 << 20;

/// Files that a process must be able to open. The planner has 145 open in flight, the keeper 139.
pub const DESCRIPTORS: u64 = 512;

struct Reserved {
    limits: Limits,
    bytes: u64,
}

impl ChannelVisitor for Reserved {
    fn visit<C: Channel>(&mut self) {
        self.bytes += self.limits.reserved_bytes::<C>();
    }
}

/// Shared memory that a mission reserves, bytes: every channel of the table, and what lies around them.
#[must_use]
pub fn shared_memory_need_bytes(config: &Config) -> u64 {
    let mut reserved = Reserved { limits: Limits::of(config), bytes: BESIDES_BYTES };
    visit_all(&mut reserved);
    reserved.bytes
}

/// Disk space that a mission may take, bytes: keyframes as PNG, three checkpoints with the optimiser's moments, models.
#[must_use]
pub fn disk_need_bytes(config: &Config) -> u64 {
    let pixels = u64::from(config.camera.width_px) * u64::from(config.camera.height_px);
    let views = u64::from(config.planner.keyframes) + 2;
    views * pixels * 4 + Limits::of(config).gaussians as u64 * GAUSSIAN_BYTES * 3 / 2 + (4 << 20)
}

/// What the services take without any Gaussians, and for each one of the model, bytes: trainer and scorer together, measured
/// at 100,000 and 500,000 (`services/splatting/README.md`), with a third to spare.
const SERVICES_BYTES: u64 = 150 << 20;
/// See [`SERVICES_BYTES`].
const BYTES_PER_GAUSSIAN: u64 = 350;

/// Memory that a mission may take at its model's cap, bytes, with what it reserves in shared memory.
#[must_use]
pub fn memory_need_bytes(config: &Config) -> u64 {
    let gaussians = Limits::of(config).gaussians as u64;
    SERVICES_BYTES + BYTES_PER_GAUSSIAN * gaussians + shared_memory_need_bytes(config)
}

/// Memory that processes may still take, bytes: of the machine, or of the container where that has a limit. `None` where the
/// system does not say.
#[must_use]
pub fn memory_available_bytes() -> Option<u64> {
    let machine = available_of(&std::fs::read_to_string("/proc/meminfo").ok()?)?;
    let number = |name| std::fs::read_to_string(Path::new("/sys/fs/cgroup").join(name)).ok()?.trim().parse().ok();
    // Files that the kernel keeps in memory give way.
    let kept = std::fs::read_to_string("/sys/fs/cgroup/memory.stat").map_or(0, |stat| file_cache_of(&stat));
    let used = number("memory.current").unwrap_or(0_u64).saturating_sub(kept);
    let container: Option<u64> = number("memory.max").map(|most: u64| most.saturating_sub(used));
    Some(container.map_or(machine, |bytes| bytes.min(machine)))
}

/// Bytes of files in memory, of a control group's memory.stat.
fn file_cache_of(stat: &str) -> u64 {
    let pages = stat.lines().filter_map(|line| line.split_once(' '));
    pages
        .filter(|(name, _)| ["active_file", "inactive_file"].contains(name))
        .filter_map(|(_, n)| n.parse::<u64>().ok())
        .sum()
}

/// `MemAvailable` of /proc/meminfo.
fn available_of(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kb| kb << 10)
}

/// Size and free space of the file system that holds a path, bytes.
///
/// # Errors
/// When there is no such path.
pub fn space_bytes(path: &Path) -> std::io::Result<(u64, u64)> {
    let status = statvfs(path)?;
    Ok((status.f_blocks * status.f_frsize, status.f_bavail * status.f_frsize))
}

/// Everything that keeps this machine from flying this mission into a folder.
///
/// # Errors
/// Exit 69, with what is missing and the way out.
pub fn check_machine(folder: &Path, config: &Config) -> anyhow::Result<()> {
    check_descriptors()?;
    check_memory(config, memory_available_bytes())?;
    check_shared_memory(config)?;
    check_disk(folder, config)
}

/// Files that this process may open, and those that it starts: as many as it may allow itself.
#[must_use]
pub fn raised_descriptors() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let most = limit.maximum.unwrap_or(u64::MAX);
    let now = limit.current.unwrap_or(u64::MAX);
    if now < DESCRIPTORS && now < most {
        let raised = Rlimit { current: Some(most.min(2 * DESCRIPTORS)), ..limit };
        if setrlimit(Resource::Nofile, raised).is_ok() {
            return most.min(2 * DESCRIPTORS);
        }
    }
    now
}

fn check_descriptors() -> anyhow::Result<()> {
    match raised_descriptors() {
        limit if limit >= DESCRIPTORS => Ok(()),
        limit => Err(Refusal::missing(format!(
            "a process may open {limit} files, expected at least {DESCRIPTORS}: `ulimit -n 1024`, in a unit LimitNOFILE=1024, \
             in a container `--ulimit nofile=1024`"
        ))),
    }
}

fn mib(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

fn check_memory(config: &Config, available: Option<u64>) -> anyhow::Result<()> {
    let need = memory_need_bytes(config);
    match available {
        Some(available) if available < need => Err(Refusal::missing(format!(
            "memory: {} MiB available, expected at least {} MiB; end other programs, lower model.max_gaussians ({}), or begin \
             with the profile of a small computer (/usr/share/vantage/profiles)",
            mib(available),
            mib(need),
            config.model.max_gaussians
        ))),
        Some(_) | None => Ok(()),
    }
}

fn check_shared_memory(config: &Config) -> anyhow::Result<()> {
    let need = shared_memory_need_bytes(config);
    match space_bytes(Path::new(SHARED_MEMORY_DIR)) {
        Err(error) => Err(Refusal::missing(format!(
            "{SHARED_MEMORY_DIR}: {error}; expected a tmpfs with {} MiB free: mount one (`mount -t tmpfs tmpfs {SHARED_MEMORY_DIR}`)",
            mib(need)
        ))),
        Ok((_, free)) if free < need => Err(Refusal::missing(format!(
            "{SHARED_MEMORY_DIR}: {} MiB free, expected at least {} MiB; enlarge it (`mount -o remount,size=1G {SHARED_MEMORY_DIR}`, \
             docker `--shm-size 1g`), remove leftovers (`vantage doctor --clean`) or lower model.max_gaussians ({})",
            mib(free),
            mib(need),
            config.model.max_gaussians
        ))),
        Ok(_) => Ok(()),
    }
}

fn check_disk(folder: &Path, config: &Config) -> anyhow::Result<()> {
    let need = disk_need_bytes(config);
    // Nothing is made before it is known to fit: the disk is that of the nearest folder that is there.
    let there = folder.ancestors().find(|ancestor| ancestor.exists()).unwrap_or(Path::new("/"));
    let (_, free) = space_bytes(there)?;
    if free >= need {
        return Ok(());
    }
    Err(Refusal::missing(format!(
        "{}: {} MiB free, expected at least {} MiB for {} keyframes and the model; free disk space, or choose another folder with --output",
        folder.display(),
        mib(free),
        mib(need),
        config.planner.keyframes
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_need_grows_with_the_model_and_the_image() {
        let small = shared_types::config::preset("tiny").expect("preset");
        let large = Config::default();
        println!(
            "tiny {} MiB, default {} MiB",
            mib(shared_memory_need_bytes(&small)),
            mib(shared_memory_need_bytes(&large))
        );
        assert!(shared_memory_need_bytes(&small) < shared_memory_need_bytes(&large) / 2);
        assert!(disk_need_bytes(&small) < disk_need_bytes(&large) / 2);
    }

    #[test]
    fn available_memory_is_read_as_the_kernel_writes_it() {
        assert_eq!(available_of("MemTotal:       24 kB\nMemAvailable:   12 kB\n"), Some(12 << 10));
        assert_eq!(available_of("MemTotal:       24 kB\n"), None);
        assert_eq!(available_of("MemAvailable: much kB\n"), None);
        assert_eq!(file_cache_of("anon 9\nfile 700\ninactive_file 300\nactive_file 40\n"), 340);
        assert!(memory_available_bytes().is_some_and(|bytes| bytes > 1 << 20));
    }

    #[test]
    fn a_machine_that_is_too_small_is_told_the_way_out() {
        let mut config = Config::default();
        config.model.max_gaussians = 4_000_000_000;
        let message = check_shared_memory(&config).expect_err("too small").to_string();
        assert!(message.contains("/dev/shm") && message.contains("model.max_gaussians"), "{message}");
        let message = check_memory(&config, Some(700 << 20)).expect_err("too small").to_string();
        assert!(message.contains("memory: 700 MiB available") && message.contains("profiles"), "{message}");
        check_memory(&Config::default(), Some(700 << 20)).expect("a gigabyte is enough for the default");
        check_memory(&config, None).expect("nobody says how much there is");
        config.camera.width_px = 1_000_000;
        config.camera.height_px = 1_000_000;
        let folder = Path::new("/tmp/not/yet/there");
        let message = check_disk(folder, &config).expect_err("too small").to_string();
        assert!(message.contains("--output") && message.contains("/tmp/not/yet/there"), "{message}");
        assert!(!folder.exists());
    }
}
