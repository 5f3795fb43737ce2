//! A device with its queue, and what it reports: faults instead of panics, bytes by name.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use wgpu::util::DeviceExt;
use wgpu::{
    Adapter, Buffer, BufferDescriptor, BufferUsages, CommandEncoder, Device, DeviceType, DownlevelFlags, Features,
    Limits, MapMode, PollType, Queue,
};

use super::error::GpuError;

/// After so long without an answer a GPU counts as hung. Drivers reset theirs after 2 to 10 s.
const PATIENCE: Duration = Duration::from_secs(30);
/// Software renders slowly, and nobody resets it.
const PATIENCE_SOFTWARE: Duration = Duration::from_secs(600);

/// What the kernels need of any adapter.
const STORAGE_BUFFERS: u32 = 8;
const INVOCATIONS: u32 = 256;
const WORKGROUP_BYTES: u32 = 16 << 10;

pub(super) struct Context {
    pub device: Device,
    pub queue: Queue,
    pub name: String,
    pub features: Features,
    pub max_binding: u64,
    /// Whether a buffer can say how many workgroups there are.
    pub indirect: bool,
    patience: Duration,
    up: AtomicU64,
    down: AtomicU64,
    fault: Arc<Mutex<Option<GpuError>>>,
}

impl Context {
    pub fn new(adapter: &Adapter, excluded: Features) -> Result<Self, GpuError> {
        let info = adapter.get_info();
        let limits = adapter.limits();
        let needs = [
            ("storage buffers per kernel", limits.max_storage_buffers_per_shader_stage, STORAGE_BUFFERS),
            ("threads per workgroup", limits.max_compute_invocations_per_workgroup, INVOCATIONS),
            ("bytes shared by a workgroup", limits.max_compute_workgroup_storage_size, WORKGROUP_BYTES),
        ];
        for (what, found, needed) in needs {
            if found < needed {
                let (found, needed) = (found.into(), needed.into());
                return Err(GpuError::Limit { adapter: info.name, what, found, needed });
            }
        }
        let wanted = Features::SUBGROUP | Features::SHADER_FLOAT32_ATOMIC | Features::TIMESTAMP_QUERY;
        let features = adapter.features() & wanted & !excluded;
        let required_limits = Limits {
            max_storage_buffers_per_shader_stage: STORAGE_BUFFERS,
            max_compute_invocations_per_workgroup: INVOCATIONS,
            max_compute_workgroup_storage_size: WORKGROUP_BYTES,
            max_compute_workgroup_size_x: INVOCATIONS,
            max_storage_buffer_binding_size: limits.max_storage_buffer_binding_size,
            max_buffer_size: limits.max_buffer_size,
            ..Limits::downlevel_defaults()
        };
        let max_binding = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("vantage"),
            required_features: features,
            required_limits,
            memory_hints: wgpu::MemoryHints::MemoryUsage,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| GpuError::NoDevice { adapter: info.name.clone(), reason: error.to_string() })?;
        let fault = Arc::new(Mutex::new(None));
        let first = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error| {
            // The first one is the cause.
            first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(fault_of(error));
        }));
        let lost = Arc::clone(&fault);
        device.set_device_lost_callback(move |reason, message| {
            let found = GpuError::Lost(format!("{message} ({reason:?})"));
            *lost.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        });
        let indirect = adapter.get_downlevel_capabilities().flags.contains(DownlevelFlags::INDIRECT_EXECUTION);
        let patience = if info.device_type == DeviceType::Cpu { PATIENCE_SOFTWARE } else { PATIENCE };
        Ok(Self {
            device,
            queue,
            name: info.name,
            features,
            max_binding,
            indirect,
            patience,
            up: AtomicU64::new(0),
            down: AtomicU64::new(0),
            fault,
        })
    }

    /// What went wrong so far, if anything.
    pub fn check(&self) -> Result<(), GpuError> {
        match &*self.fault.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(fault) => Err(fault.clone()),
            None => Ok(()),
        }
    }

    pub fn encoder(&self) -> CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: None })
    }

    /// A buffer for kernels, to be written and read by the host by copies; never empty.
    pub fn storage(&self, what: &'static str, bytes: u64) -> Result<Buffer, GpuError> {
        let bytes = bytes.max(64).next_multiple_of(16);
        if bytes > self.max_binding {
            return Err(GpuError::TooLarge { what, needed: bytes, limit: self.max_binding });
        }
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC;
        Ok(self.buffer(what, bytes, usage))
    }

    pub fn buffer(&self, what: &'static str, bytes: u64, usage: BufferUsages) -> Buffer {
        self.device.create_buffer(&BufferDescriptor {
            label: Some(what),
            size: bytes,
            usage,
            mapped_at_creation: false,
        })
    }

    /// A uniform buffer that is never changed.
    pub fn constant(&self, contents: &[u8]) -> Buffer {
        self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("constant"),
            contents,
            usage: BufferUsages::UNIFORM,
        })
    }

    /// A buffer for kernels with these contents.
    pub fn filled(&self, what: &'static str, contents: &[u8]) -> Result<Buffer, GpuError> {
        let buffer = self.storage(what, contents.len() as u64)?;
        self.write(&buffer, 0, contents);
        Ok(buffer)
    }

    /// Puts bytes into a buffer, from `offset` on.
    pub fn write(&self, buffer: &Buffer, offset: u64, contents: &[u8]) {
        if !contents.is_empty() {
            self.up.fetch_add(contents.len() as u64, Ordering::Relaxed);
            self.queue.write_buffer(buffer, offset, contents);
        }
    }

    /// Bytes of models, lists and images that went up so far, and that came down.
    pub fn traffic(&self) -> (u64, u64) {
        (self.up.load(Ordering::Relaxed), self.down.load(Ordering::Relaxed))
    }

    /// A buffer that the host can map.
    pub fn staging(&self, bytes: u64) -> Buffer {
        let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        self.buffer("staging", bytes.max(64).next_multiple_of(16), usage)
    }

    /// Reads the beginning of some buffers, after all work that was submitted before.
    pub fn read<const N: usize>(&self, from: [(&Buffer, u64); N]) -> Result<[Vec<u8>; N], GpuError> {
        self.check()?;
        let mut encoder = self.encoder();
        self.down.fetch_add(from.iter().map(|(_, bytes)| bytes).sum(), Ordering::Relaxed);
        let staging = from.map(|(buffer, bytes)| {
            let staging = self.staging(bytes);
            encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
            staging
        });
        self.queue.submit([encoder.finish()]);
        let waiting = staging.each_ref().map(Mapping::begin);
        self.wait()?;
        let mut out = [const { Vec::new() }; N];
        for ((out, mapping), (buffer, (_, bytes))) in out.iter_mut().zip(waiting).zip(staging.iter().zip(from)) {
            *out = mapping.take(self, buffer, bytes)?;
        }
        Ok(out)
    }

    /// Waits for everything that was submitted.
    pub fn wait(&self) -> Result<(), GpuError> {
        let waited = self.device.poll(PollType::Wait { submission_index: None, timeout: Some(self.patience) });
        self.check()?;
        match waited {
            Ok(_) => Ok(()),
            Err(wgpu::PollError::Timeout) => Err(GpuError::Silent(self.patience.as_secs())),
            Err(error) => Err(GpuError::Refused(error.to_string())),
        }
    }

    /// Lets callbacks run for what is finished.
    pub fn poll(&self) -> Result<(), GpuError> {
        let polled = self.device.poll(PollType::Poll);
        self.check()?;
        polled.map(|_| ()).map_err(|error| GpuError::Refused(error.to_string()))
    }
}

/// What an error that the device reports by itself is.
fn fault_of(error: wgpu::Error) -> GpuError {
    match error {
        wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(source.to_string()),
        other => GpuError::Refused(other.to_string()),
    }
}

/// A buffer on its way to the host.
pub(super) struct Mapping {
    done: mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
}

impl Mapping {
    pub fn begin(buffer: &Buffer) -> Self {
        let (sender, done) = mpsc::sync_channel(1);
        buffer.map_async(MapMode::Read, .., move |result| {
            // Nobody listens any more where the engine was dropped meanwhile.
            sender.send(result).ok();
        });
        Self { done }
    }

    /// Whether it has arrived; takes the answer.
    pub fn arrived(&self) -> Option<Result<(), GpuError>> {
        match self.done.try_recv() {
            Ok(result) => Some(result.map_err(|error| GpuError::Refused(error.to_string()))),
            Err(mpsc::TryRecvError::Empty) => None,
            Err(mpsc::TryRecvError::Disconnected) => Some(Err(GpuError::Lost("a readback was dropped".to_owned()))),
        }
    }

    /// The bytes of a buffer that has arrived.
    pub fn take(&self, context: &Context, buffer: &Buffer, bytes: u64) -> Result<Vec<u8>, GpuError> {
        match self.arrived() {
            Some(result) => result?,
            None => return Err(GpuError::Silent(context.patience.as_secs())),
        }
        copy(buffer, bytes)
    }
}

/// Copies what a mapped buffer holds, and unmaps it.
pub(super) fn copy(buffer: &Buffer, bytes: u64) -> Result<Vec<u8>, GpuError> {
    let copied = match buffer.get_mapped_range(..) {
        Ok(view) => Ok(view[..bytes as usize].to_vec()),
        Err(error) => Err(GpuError::Refused(error.to_string())),
    };
    buffer.unmap();
    copied
}

#[cfg(test)]
mod unit_tests {
    use super::*;

    #[test]
    fn a_full_memory_is_told_from_a_refusal() {
        let source = || Box::new(std::io::Error::other("VK_ERROR_OUT_OF_DEVICE_MEMORY"));
        let full = fault_of(wgpu::Error::OutOfMemory { source: source() });
        assert!(full.to_string().contains("out of memory") && full.to_string().contains("DEVICE_MEMORY"), "{full}");
        let description = "binding 3 is missing".to_owned();
        let refused = fault_of(wgpu::Error::Validation { source: source(), description });
        assert!(matches!(refused, GpuError::Refused(_)));
    }
}
