//! Which GPU: a list of what there is, and the choice.

use wgpu::{Adapter, DeviceType, Features, Instance, InstanceFlags};

use super::error::GpuError;

/// An adapter as people want to see it listed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterReport {
    /// Name, by which it can be asked for.
    pub name: String,
    /// Interface: Vulkan, Metal, Dx12.
    pub interface: String,
    /// Driver, with its version.
    pub driver: String,
    /// Whether it renders on the CPU.
    pub is_software: bool,
    /// Smallest and largest subgroup; `None` without subgroup operations.
    pub subgroups: Option<(u32, u32)>,
    /// Whether floats can be added atomically.
    pub float_atomics: bool,
    /// Whether stages can be timed.
    pub timestamps: bool,
    /// Largest part of a buffer that a kernel can see, bytes.
    pub max_binding_bytes: u64,
    /// Largest buffer, bytes.
    pub max_buffer_bytes: u64,
    /// Storage buffers that a kernel can see.
    pub storage_buffers: u32,
    /// Memory that the threads of a workgroup share, bytes.
    pub workgroup_bytes: u32,
}

impl AdapterReport {
    fn new(adapter: &Adapter) -> Self {
        let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
        Self {
            name: info.name,
            interface: info.backend.to_string(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            is_software: info.device_type == DeviceType::Cpu,
            subgroups: features
                .contains(Features::SUBGROUP)
                .then_some((info.subgroup_min_size, info.subgroup_max_size)),
            float_atomics: features.contains(Features::SHADER_FLOAT32_ATOMIC),
            timestamps: features.contains(Features::TIMESTAMP_QUERY),
            max_binding_bytes: limits.max_storage_buffer_binding_size,
            max_buffer_bytes: limits.max_buffer_size,
            storage_buffers: limits.max_storage_buffers_per_shader_stage,
            workgroup_bytes: limits.max_compute_workgroup_storage_size,
        }
    }
}

/// All adapters of this machine. None where there is no driver; nothing fails then.
pub fn adapters() -> Vec<AdapterReport> {
    enumerate().iter().map(AdapterReport::new).collect()
}

/// Whether it is worth loading a driver to look: on Linux a GPU has a device node.
pub fn may_exist() -> bool {
    if !cfg!(target_os = "linux") {
        return true;
    }
    let is_node = |name: &std::ffi::OsStr| name.to_str().is_some_and(|name| name.starts_with("renderD"));
    let rendering = std::fs::read_dir("/dev/dri");
    rendering.is_ok_and(|nodes| nodes.flatten().any(|node| is_node(&node.file_name())))
        || ["/dev/nvidiactl", "/dev/nvgpu", "/dev/mali0", "/dev/kgsl-3d0", "/dev/dxg"]
            .iter()
            .any(|node| std::path::Path::new(node).exists())
}

fn enumerate() -> Vec<Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    // Sizes of indirect dispatches are clamped by the kernel that writes them; a dispatch more to check each would cost as
    // much as they save.
    descriptor.flags.remove(InstanceFlags::VALIDATION_INDIRECT_CALL);
    let instance = Instance::new(descriptor);
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY))
}

/// The adapter of this name (upper or lower case, a part of it is enough), or the best one that is not software: discrete
/// before integrated before virtual.
pub(super) fn choose(name: Option<&str>) -> Result<Adapter, GpuError> {
    let mut adapters = enumerate();
    let names = |adapters: &[Adapter]| adapters.iter().map(|a| a.get_info().name).collect::<Vec<_>>();
    if let Some(wanted) = name {
        let matches = |a: &Adapter| a.get_info().name.to_lowercase().contains(&wanted.to_lowercase());
        let Some(at) = adapters.iter().position(matches) else {
            return Err(GpuError::NoSuchAdapter { wanted: wanted.to_owned(), found: names(&adapters) });
        };
        return Ok(adapters.swap_remove(at));
    }
    let rank = |adapter: &Adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => Some(0),
        DeviceType::IntegratedGpu => Some(1),
        DeviceType::VirtualGpu => Some(2),
        DeviceType::Other => Some(3),
        DeviceType::Cpu => None,
    };
    let best = (0..adapters.len()).filter_map(|i| Some((rank(&adapters[i])?, i))).min();
    match best {
        Some((_, at)) => Ok(adapters.swap_remove(at)),
        None if adapters.is_empty() => Err(GpuError::NoAdapter),
        None => Err(GpuError::OnlySoftware { found: names(&adapters) }),
    }
}
