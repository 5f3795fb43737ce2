//! What an adapter can do at best, for benchmarks: multiply-adds and memory.

use std::time::Instant;

use wgpu::{BufferUsages, ComputePassDescriptor};

use super::context::Context;
use super::error::GpuError;

/// Operations of one thread of `peak.wgsl`: 512 rounds of eight chains of four multiply-adds.
const OPERATIONS: f64 = 512.0 * 8.0 * 4.0 * 2.0;
const WORKGROUPS: u32 = 4096;
const COPY_BYTES: u64 = 256 << 20;
/// Measurements, of which the best counts; not more than so many seconds.
const ATTEMPTS: usize = 20;
const PATIENCE_S: f64 = 2.0;

/// Peak of multiply-adds, GFLOP/s, and of a copy, GB/s read and written together.
pub(super) fn measure(context: &Context) -> Result<(f64, f64), GpuError> {
    Ok((multiply_adds(context)?, copies(context)?))
}

fn best(mut attempt: impl FnMut() -> Result<(), GpuError>) -> Result<f64, GpuError> {
    attempt()?;
    let (begun, mut least) = (Instant::now(), f64::INFINITY);
    for _ in 0..ATTEMPTS {
        let start = Instant::now();
        attempt()?;
        least = least.min(start.elapsed().as_secs_f64());
        if begun.elapsed().as_secs_f64() > PATIENCE_S {
            break;
        }
    }
    Ok(least)
}

fn multiply_adds(context: &Context) -> Result<f64, GpuError> {
    let device = &context.device;
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("peak"),
        source: wgpu::ShaderSource::Wgsl(include_str!("shaders/peak.wgsl").into()),
    });
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("peak"),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let out = context.storage("peak", 1 << 16)?;
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry { binding: 0, resource: out.as_entire_binding() }],
    });
    let run = |workgroups: u32| {
        best(|| {
            let mut encoder = context.encoder();
            let mut pass = encoder.begin_compute_pass(&ComputePassDescriptor::default());
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups(workgroups, 1, 1);
            drop(pass);
            context.queue.submit([encoder.finish()]);
            context.wait()
        })
    };
    // A sixteenth first, so that what a submission costs can be taken off.
    let few = run(WORKGROUPS / 16)?;
    let seconds = (run(WORKGROUPS)? - few).max(1e-9);
    Ok(OPERATIONS * 256.0 * f64::from(WORKGROUPS - WORKGROUPS / 16) / seconds / 1e9)
}

fn copies(context: &Context) -> Result<f64, GpuError> {
    let bytes = COPY_BYTES.min(context.max_binding);
    let usage = BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
    let (from, to) = (context.buffer("peak", bytes, usage), context.buffer("peak", bytes, usage));
    context.check()?;
    let run = |times: usize| {
        best(|| {
            let mut encoder = context.encoder();
            for _ in 0..times {
                encoder.copy_buffer_to_buffer(&from, 0, &to, 0, bytes);
            }
            context.queue.submit([encoder.finish()]);
            context.wait()
        })
    };
    let once = run(1)?;
    let seconds = (run(5)? - once).max(1e-9);
    Ok(2.0 * 4.0 * bytes as f64 / seconds / 1e9)
}
