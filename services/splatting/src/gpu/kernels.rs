//! Pipelines of all kernels, and what each is bound to.

use wgpu::{
    BindGroup, BindGroupDescriptor, BindGroupEntry, BindGroupLayout, BindGroupLayoutDescriptor, BindGroupLayoutEntry,
    BindingType, Buffer, BufferBinding, BufferBindingType, BufferSize, ComputePipeline, Features, ShaderStages,
};

use super::context::Context;
use super::error::GpuError;
use super::job::{JOB_BYTES, VIEW_BYTES};

/// What a kernel sees at a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// The job: uniform, with an offset for each dispatch.
    Job,
    /// Views: read, with an offset for each dispatch.
    Views,
    Read,
    Write,
    /// Uniform, the same for every dispatch.
    Constant,
}

use Kind::{Constant, Job, Read, Views, Write};

/// A kernel: its source in parts, and its bindings.
pub(super) struct Source {
    pub name: &'static str,
    parts: &'static [&'static str],
    group0: &'static [Kind],
    group1: &'static [Kind],
}

macro_rules! shader {
    ($name:literal) => {
        include_str!(concat!("shaders/", $name, ".wgsl"))
    };
}

const JOB: &str = shader!("job");
const PROJECTION: &str = shader!("projection");
const HARMONICS: &str = shader!("harmonics");
const PARAMETERS: &str = shader!("parameters");
const TILE_LISTS: &str = shader!("tile_lists");
const MOMENTS: &str = shader!("moments");
const KEYFRAME: &str = shader!("keyframe");
const BACKWARD: &str = shader!("backward");
const GROUPS: &str = shader!("groups");
const SORT_MOVE: &str = shader!("sort_move");

const BACKWARD_BINDINGS: &[Kind] = &[Job, Views, Read, Read, Read, Read, Read, Write];
const SORT_BINDINGS: &[Kind] = &[Job, Read, Read, Read, Write, Write, Write, Write];

/// Every kernel, with both variants of those that have two.
pub(super) const SOURCES: &[Source] = &[
    Source {
        name: "project",
        parts: &[JOB, PROJECTION, HARMONICS, shader!("project")],
        group0: &[Job, Views, Read, Read, Write, Write, Write],
        group1: &[],
    },
    Source {
        name: "sort_count",
        parts: &[JOB, GROUPS, shader!("sort_count")],
        group0: &[Job, Read, Read, Write],
        group1: &[Constant],
    },
    Source {
        name: "sort_move_plain",
        parts: &[JOB, GROUPS, SORT_MOVE, shader!("sort_move_plain")],
        group0: SORT_BINDINGS,
        group1: &[Constant],
    },
    Source {
        name: "sort_move_subgroup",
        parts: &[JOB, GROUPS, SORT_MOVE, shader!("sort_move_subgroup")],
        group0: SORT_BINDINGS,
        group1: &[Constant],
    },
    Source {
        name: "bin_count",
        parts: &[JOB, GROUPS, shader!("bin_count")],
        group0: &[Job, Read, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "bin_offsets",
        parts: &[JOB, GROUPS, shader!("bin_offsets")],
        group0: &[Job, Write, Write, Write],
        group1: &[],
    },
    Source {
        name: "bin_fill",
        parts: &[JOB, GROUPS, shader!("bin_fill")],
        group0: &[Job, Read, Read, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "blend",
        parts: &[JOB, TILE_LISTS, shader!("blend")],
        group0: &[Job, Views, Read, Read, Read, Write, Write],
        group1: &[],
    },
    Source {
        name: "moments_store",
        parts: &[JOB, TILE_LISTS, MOMENTS, shader!("moments_store")],
        group0: &[Job, Views, Read, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "moments_variance",
        parts: &[JOB, TILE_LISTS, MOMENTS, shader!("moments_variance")],
        group0: &[Job, Views, Read, Read, Read, Write, Read, Read],
        group1: &[],
    },
    Source {
        name: "ssim",
        parts: &[JOB, KEYFRAME, shader!("ssim")],
        group0: &[Job, Views, Read, Write, Write],
        group1: &[Read, Read, Read],
    },
    Source {
        name: "loss",
        parts: &[JOB, KEYFRAME, shader!("loss")],
        group0: &[Job, Views, Write, Read, Write],
        group1: &[Read, Read, Read],
    },
    Source {
        name: "backward_native",
        parts: &[JOB, BACKWARD, shader!("settle_native")],
        group0: BACKWARD_BINDINGS,
        group1: &[],
    },
    Source {
        name: "backward_compare",
        parts: &[JOB, BACKWARD, shader!("settle_compare")],
        group0: BACKWARD_BINDINGS,
        group1: &[],
    },
    Source {
        name: "backward_ordered",
        parts: &[JOB, BACKWARD, shader!("settle_ordered")],
        group0: BACKWARD_BINDINGS,
        group1: &[],
    },
    Source {
        name: "gather",
        parts: &[JOB, shader!("gather")],
        group0: &[Job, Read, Read, Read, Read, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "observe",
        parts: &[JOB, PROJECTION, shader!("observe")],
        group0: &[Job, Views, Read, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "noise",
        parts: &[JOB, PROJECTION, shader!("noise")],
        group0: &[Job, Write, Read, Read],
        group1: &[],
    },
    Source {
        name: "adam",
        parts: &[JOB, PROJECTION, HARMONICS, PARAMETERS, shader!("adam")],
        group0: &[Job, Views, Write, Write, Write, Write, Write, Write, Write],
        group1: &[],
    },
    Source {
        name: "gradient",
        parts: &[JOB, PROJECTION, HARMONICS, PARAMETERS, shader!("gradient")],
        group0: &[Job, Views, Read, Read, Write, Write, Write, Write],
        group1: &[],
    },
    Source { name: "select", parts: &[JOB, shader!("select")], group0: &[Constant, Read, Read, Write], group1: &[] },
    Source { name: "insert", parts: &[JOB, shader!("insert")], group0: &[Constant, Read, Write, Write], group1: &[] },
    Source {
        name: "lower_opacities",
        parts: &[JOB, shader!("lower_opacities")],
        group0: &[Constant, Write, Write],
        group1: &[],
    },
    Source {
        name: "prune_view",
        parts: &[JOB, PROJECTION, shader!("prune_view")],
        group0: &[Constant, Read, Read, Write],
        group1: &[],
    },
    Source {
        name: "prune",
        parts: &[JOB, PROJECTION, shader!("prune")],
        group0: &[Constant, Read, Read, Write],
        group1: &[],
    },
    Source { name: "metrics", parts: &[JOB, shader!("metrics")], group0: &[Job, Read, Read, Write], group1: &[] },
];

impl Source {
    pub fn wgsl(&self) -> String {
        self.parts.join("\n")
    }

    fn named(name: &str) -> Option<&'static Self> {
        SOURCES.iter().find(|source| source.name == name)
    }
}

/// A compiled kernel.
pub(super) struct Kernel {
    pub pipeline: ComputePipeline,
    kinds: [&'static [Kind]; 2],
    layouts: [BindGroupLayout; 2],
}

impl Kernel {
    /// Compiles a kernel of [`SOURCES`].
    fn new(context: &Context, name: &str) -> Result<Self, GpuError> {
        let Some(source) = Source::named(name) else {
            return Err(GpuError::Refused(format!("no kernel is named {name}")));
        };
        let device = &context.device;
        let layouts = [source.group0, source.group1].map(|kinds| layout(context, source.name, kinds));
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(source.name),
            bind_group_layouts: &[Some(&layouts[0]), (!source.group1.is_empty()).then_some(&layouts[1])]
                [..1 + usize::from(!source.group1.is_empty())],
            immediate_size: 0,
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(source.name),
            source: wgpu::ShaderSource::Wgsl(source.wgsl().into()),
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(source.name),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        context.check()?;
        Ok(Self { pipeline, kinds: [source.group0, source.group1], layouts })
    }

    /// Binds buffers to group 0, in the order of its bindings. `views` is how many views the kernel sees at once.
    pub fn bind(&self, context: &Context, views: u64, buffers: &[&Buffer]) -> BindGroup {
        self.bind_group(context, 0, views, buffers)
    }

    /// Binds buffers to group 1.
    pub fn bind_second(&self, context: &Context, buffers: &[&Buffer]) -> BindGroup {
        self.bind_group(context, 1, 1, buffers)
    }

    fn bind_group(&self, context: &Context, group: usize, views: u64, buffers: &[&Buffer]) -> BindGroup {
        let part = |bytes: u64| BufferSize::new(bytes);
        let entries: Vec<BindGroupEntry<'_>> = (0..)
            .zip(buffers.iter().zip(self.kinds[group]))
            .map(|(binding, (buffer, kind))| {
                let size = match kind {
                    Job => part(JOB_BYTES),
                    Views => part(views * VIEW_BYTES),
                    Read | Write | Constant => None,
                };
                let resource = wgpu::BindingResource::Buffer(BufferBinding { buffer, offset: 0, size });
                BindGroupEntry { binding, resource }
            })
            .collect();
        context.device.create_bind_group(&BindGroupDescriptor {
            label: None,
            layout: &self.layouts[group],
            entries: &entries,
        })
    }

    /// Offsets for a dispatch: of its job and, where it has them, its views.
    pub fn offsets<'a>(&self, offsets: &'a [u32; 2]) -> &'a [u32] {
        let dynamic = self.kinds[0].iter().filter(|kind| matches!(kind, Job | Views)).count();
        &offsets[..dynamic]
    }
}

fn layout(context: &Context, name: &'static str, kinds: &[Kind]) -> BindGroupLayout {
    let entries: Vec<BindGroupLayoutEntry> = (0..)
        .zip(kinds)
        .map(|(binding, kind)| BindGroupLayoutEntry {
            binding,
            visibility: ShaderStages::COMPUTE,
            ty: BindingType::Buffer {
                ty: match kind {
                    Job | Constant => BufferBindingType::Uniform,
                    Views | Read => BufferBindingType::Storage { read_only: true },
                    Write => BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: matches!(kind, Job | Views),
                min_binding_size: None,
            },
            count: None,
        })
        .collect();
    context.device.create_bind_group_layout(&BindGroupLayoutDescriptor { label: Some(name), entries: &entries })
}

/// All pipelines of an engine.
pub(super) struct Kernels {
    pub project: Kernel,
    pub sort_count: Kernel,
    pub sort_move: Kernel,
    pub bin_count: Kernel,
    pub bin_offsets: Kernel,
    pub bin_fill: Kernel,
    pub blend: Kernel,
    pub moments_store: Kernel,
    pub moments_variance: Kernel,
    pub ssim: Kernel,
    pub loss: Kernel,
    pub backward: Kernel,
    /// Where the backward pass is deterministic.
    pub gather: Option<Kernel>,
    pub observe: Kernel,
    pub noise: Kernel,
    pub adam: Kernel,
    pub gradient: Kernel,
    pub metrics: Kernel,
    pub select: Kernel,
    pub insert: Kernel,
    pub lower_opacities: Kernel,
    pub prune_view: Kernel,
    pub prune: Kernel,
}

impl Kernels {
    pub fn new(context: &Context, deterministic: bool) -> Result<Self, GpuError> {
        let kernel = |name| Kernel::new(context, name);
        let has = |feature| context.features.contains(feature);
        Ok(Self {
            project: kernel("project")?,
            sort_count: kernel("sort_count")?,
            sort_move: kernel(if has(Features::SUBGROUP) { "sort_move_subgroup" } else { "sort_move_plain" })?,
            bin_count: kernel("bin_count")?,
            bin_offsets: kernel("bin_offsets")?,
            bin_fill: kernel("bin_fill")?,
            blend: kernel("blend")?,
            moments_store: kernel("moments_store")?,
            moments_variance: kernel("moments_variance")?,
            ssim: kernel("ssim")?,
            loss: kernel("loss")?,
            backward: kernel(match has(Features::SHADER_FLOAT32_ATOMIC) {
                _ if deterministic => "backward_ordered",
                true => "backward_native",
                false => "backward_compare",
            })?,
            gather: if deterministic { Some(kernel("gather")?) } else { None },
            observe: kernel("observe")?,
            noise: kernel("noise")?,
            adam: kernel("adam")?,
            gradient: kernel("gradient")?,
            metrics: kernel("metrics")?,
            select: kernel("select")?,
            insert: kernel("insert")?,
            lower_opacities: kernel("lower_opacities")?,
            prune_view: kernel("prune_view")?,
            prune: kernel("prune")?,
        })
    }
}
