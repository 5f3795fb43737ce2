//! The chain of kernels from Gaussians to the lists of splats per tile, for one view or for many at once.

use bytemuck::bytes_of;
use wgpu::{BindGroup, Buffer, BufferUsages, ComputePass};

use super::buffers::Bytes;
use super::context::Context;
use super::error::GpuError;
use super::job::{CONTROL_WORDS, Job, VIEW_BYTES, VIEWS_MAX, fold};
use super::kernels::{Kernel, Kernels};
use super::model::DeviceModel;
use crate::frame::TILE;

/// Side of the largest image, pixels: a box of tiles has a byte for each of its sides.
const SIDE_MAX: u32 = 4096;
/// Most workgroups that share the sort of a view, and its binning: enough for the largest GPUs.
const SORT_GROUPS_MAX: u32 = 128;
const BIN_GROUPS_MAX: u32 = 64;
/// Bits that a pass of the sort takes, and all bits of a depth.
const PASSES: [u32; 4] = [0, 8, 16, 24];

/// A stage on the way from Gaussians to lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Listing {
    Project,
    Sort,
    Bin,
}

/// What a chain has room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size {
    pub gaussians: u32,
    pub views: u32,
    pub width: u32,
    pub height: u32,
    /// (tile, splat) pairs of each view.
    pub capacity: u32,
}

impl Size {
    pub fn tiles_x(&self) -> u32 {
        self.width.div_ceil(TILE as u32)
    }

    pub fn tiles_y(&self) -> u32 {
        self.height.div_ceil(TILE as u32)
    }

    pub fn tiles(&self) -> u32 {
        self.tiles_x() * self.tiles_y()
    }

    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    pub fn parameter_groups(&self) -> u32 {
        self.gaussians.div_ceil(256).max(1)
    }

    /// Bytes of the largest buffers that each view needs, with those that it leaves.
    pub fn bytes_per_view(&self, out_bytes: u64) -> [u64; 3] {
        [48 * u64::from(self.gaussians), 4 * u64::from(self.capacity), out_bytes]
    }

    /// A first guess of the pairs of a view.
    pub fn likely_pairs(gaussians: u32) -> u32 {
        gaussians.saturating_mul(2).saturating_add(4096)
    }

    /// The job of this size, without settings.
    pub fn job(&self) -> Job {
        Job {
            gaussians: self.gaussians,
            sort_groups: self.gaussians.div_ceil(1024).clamp(1, SORT_GROUPS_MAX),
            bin_groups: self.gaussians.div_ceil(2048).clamp(1, BIN_GROUPS_MAX),
            capacity: self.capacity,
            width: self.width,
            height: self.height,
            tiles_x: self.tiles_x(),
            tiles_y: self.tiles_y(),
            parameter_groups: self.parameter_groups(),
            ..Job::default()
        }
    }
}

/// Buffers and bindings of a chain.
pub(super) struct Chain {
    pub size: Size,
    /// Views that are drawn, at most as many as `size` has room for.
    pub views: u32,
    pub rows: Buffer,
    pub boxes: Buffer,
    pub entries: Buffer,
    pub starts: Buffer,
    pub control: Buffer,
    pub bytes: Bytes,
    project: BindGroup,
    /// Workgroups of what comes after the first pass of the sort, where they are dispatched indirectly.
    arguments: Option<Buffer>,
    sort: [(BindGroup, BindGroup, BindGroup); 4],
    bin: [BindGroup; 3],
}

impl Chain {
    /// `views` is the buffer of views, `jobs` that of jobs.
    pub fn new(
        context: &Context,
        kernels: &Kernels,
        model: &DeviceModel,
        size: Size,
        (jobs, views): (&Buffer, &Buffer),
    ) -> Result<Self, GpuError> {
        if size.width > SIDE_MAX || size.height > SIDE_MAX {
            return Err(GpuError::TooManyPixels { width: size.width, height: size.height });
        }
        debug_assert!(size.views <= VIEWS_MAX);
        let job = size.job();
        let (gaussians, count, tiles) = (u64::from(size.gaussians), u64::from(size.views), u64::from(size.tiles()));
        let mut bytes = Bytes::default();
        let mut storage = |what: &'static str, length: u64| -> Result<Buffer, GpuError> {
            let buffer = context.storage(what, length)?;
            bytes.add(what, &buffer);
            Ok(buffer)
        };
        let rows = storage("projected splats", 48 * gaussians * count)?;
        let boxes = storage("boxes of tiles", 4 * gaussians * count)?;
        let keys = [storage("sort", 4 * gaussians * count)?, storage("sort", 4 * gaussians * count)?];
        let order = [storage("sort", 4 * gaussians * count)?, storage("sort", 4 * gaussians * count)?];
        let counts = storage("sort", 1024 * u64::from(job.sort_groups) * count)?;
        let table = storage("tile lists", 4 * u64::from(job.bin_groups) * tiles * count)?;
        let starts = storage("tile lists", 4 * (tiles + 1) * count)?;
        let entries = storage("tile lists", 4 * u64::from(size.capacity) * count)?;
        let control = storage("control", 4 * (CONTROL_WORDS + 3 * u64::from(job.parameter_groups)))?;
        // A kernel that is dispatched by a buffer must not be able to write to it: the later passes see another one.
        let idle = storage("control", 32)?;
        let usage = BufferUsages::STORAGE | BufferUsages::INDIRECT;
        let arguments = (size.views == 1 && context.indirect).then(|| context.buffer("arguments", 64, usage));
        context.check()?;

        let project = kernels.project.bind(
            context,
            count,
            &[jobs, views, &model.parameters, &model.bands, &rows, &boxes, &keys[0]],
        );
        let passes = [0, 1, 2, 3].map(|pass: usize| {
            let (from, to) = (pass % 2, (pass + 1) % 2);
            let count = kernels.sort_count.bind(context, 0, &[jobs, &keys[from], &control, &counts]);
            let arguments = arguments.as_ref().filter(|_| pass == 0).unwrap_or(&idle);
            let buffers = [jobs, &keys[from], &order[from], &counts, &control, &keys[to], &order[to], arguments];
            let moved = kernels.sort_move.bind(context, 0, &buffers);
            let constant = context.constant(bytes_of(&[PASSES[pass], u32::from(pass == 0), 0, 0]));
            (count, moved, kernels.sort_count.bind_second(context, &[&constant]))
        });
        let bin = [
            kernels.bin_count.bind(context, 0, &[jobs, &control, &order[0], &boxes, &table]),
            kernels.bin_offsets.bind(context, 0, &[jobs, &control, &table, &starts]),
            kernels.bin_fill.bind(context, 0, &[jobs, &control, &order[0], &boxes, &table, &entries]),
        ];
        context.check()?;
        Ok(Self {
            size,
            views: size.views,
            rows,
            boxes,
            entries,
            starts,
            control,
            bytes,
            project,
            arguments,
            sort: passes,
            bin,
        })
    }

    /// Records one of the stages that lead to the lists. `offsets` are those of the job and of the views.
    pub fn record(&self, stage: Listing, pass: &mut ComputePass<'_>, kernels: &Kernels, offsets: &[u32; 2]) {
        let (job, views) = (self.size.job(), self.views);
        match stage {
            Listing::Project => {
                let (x, y) = fold(self.size.parameter_groups());
                dispatch(pass, &kernels.project, &self.project, offsets, (x, y, views));
            }
            Listing::Sort => {
                let groups = (job.sort_groups, 1, views);
                for (at, (count, moved, constant)) in self.sort.iter().enumerate() {
                    pass.set_bind_group(1, constant, &[]);
                    let arguments = self.arguments.as_ref().filter(|_| at > 0).map(|buffer| (buffer, 0));
                    dispatch_by(pass, &kernels.sort_count, count, offsets, (groups, arguments));
                    dispatch_by(pass, &kernels.sort_move, moved, offsets, (groups, arguments));
                }
            }
            Listing::Bin => {
                let parts = (job.bin_groups, self.size.tiles().div_ceil(256), views);
                let arguments = self.arguments.as_ref().map(|buffer| (buffer, 16));
                dispatch_by(pass, &kernels.bin_count, &self.bin[0], offsets, (parts, arguments));
                dispatch(pass, &kernels.bin_offsets, &self.bin[1], offsets, (1, 1, views));
                dispatch_by(pass, &kernels.bin_fill, &self.bin[2], offsets, (parts, arguments));
            }
        }
    }

    /// Records all stages that lead to the lists.
    pub fn record_all(&self, pass: &mut ComputePass<'_>, kernels: &Kernels, offsets: &[u32; 2]) {
        for stage in [Listing::Project, Listing::Sort, Listing::Bin] {
            self.record(stage, pass, kernels, offsets);
        }
    }
}

/// Workgroups along each dimension.
type Grid = (u32, u32, u32);

/// Records one dispatch of a kernel with a single group of bindings.
pub(super) fn dispatch(
    pass: &mut ComputePass<'_>,
    kernel: &Kernel,
    group: &BindGroup,
    offsets: &[u32; 2],
    groups: Grid,
) {
    dispatch_by(pass, kernel, group, offsets, (groups, None));
}

/// The same, by as many workgroups as a buffer says at an offset, or as are named where there is none.
fn dispatch_by(
    pass: &mut ComputePass<'_>,
    kernel: &Kernel,
    group: &BindGroup,
    offsets: &[u32; 2],
    ((x, y, z), arguments): (Grid, Option<(&Buffer, u64)>),
) {
    #[cfg(test)]
    DISPATCHES.set(DISPATCHES.get() + 1);
    pass.set_pipeline(&kernel.pipeline);
    pass.set_bind_group(0, group, kernel.offsets(offsets));
    match arguments {
        Some((buffer, offset)) => pass.dispatch_workgroups_indirect(buffer, offset),
        None => pass.dispatch_workgroups(x, y, z),
    }
}

#[cfg(test)]
thread_local! {
    /// Dispatches that were recorded by a test.
    pub(super) static DISPATCHES: std::cell::Cell<u32> = const { std::cell::Cell::new(0) };
}

/// A buffer of views for one batch.
pub(super) fn views_buffer(context: &Context, views: u32) -> Result<Buffer, GpuError> {
    context.storage("views", VIEW_BYTES * u64::from(views))
}
