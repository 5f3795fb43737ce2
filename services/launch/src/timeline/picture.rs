//! The picture: a line for each track of each service, a bar for each stage, seconds along the bottom.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::{Stage, tracks};

/// Pixels: of the names on the left, of the axis, of a line, and between services.
const NAMES: f64 = 170.0;
const WIDTH: f64 = 1400.0;
const LINE: f64 = 22.0;
const GAP: f64 = 8.0;
/// Bars narrower than this have no name in them, pixels a letter.
const LETTER: f64 = 6.5;

/// Colours of stages by their names, told apart by eyes of all kinds (Okabe and Ito, and lighter ones of theirs).
const COLORS: [&str; 12] = [
    "#56b4e9", "#e69f00", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7", "#999999", "#8fd0f2", "#f5c466",
    "#66c5a8", "#e7b6d0",
];

pub(super) fn draw(stages: &[Stage]) -> String {
    let end_s = stages.iter().map(|stage| (stage.ts + stage.dur) / 1e6).fold(0.001, f64::max);
    let x = |s: f64| NAMES + (WIDTH - NAMES - 20.0) * s / end_s;
    let mut names: BTreeMap<&str, usize> = BTreeMap::new();
    for stage in stages {
        let next = names.len();
        names.entry(&stage.name).or_insert(next);
    }
    let (mut y, mut before, mut body) = (30.0, "", String::new());
    for (service, track) in tracks(stages) {
        if service != before {
            y += GAP;
            before = service;
        }
        push(
            &mut body,
            format_args!(
                "<text x=\"8\" y=\"{:.1}\">{}</text>\n",
                y + 0.7 * LINE,
                escaped(&if track == "main" { service.to_owned() } else { format!("{service}: {track}") })
            ),
        );
        for stage in stages.iter().filter(|stage| stage.cat == service && stage.tid == track) {
            let (left, right) = (x(stage.ts / 1e6), x((stage.ts + stage.dur) / 1e6));
            let color = COLORS[names.get(stage.name.as_str()).copied().unwrap_or(0) % COLORS.len()];
            let arguments: String = stage.args.iter().map(|(key, value)| format!("\n{key} = {value}")).collect();
            let title = format!("{} at {:.3} s, {:.1} ms{arguments}", stage.name, stage.ts / 1e6, stage.dur / 1e3);
            let width = (right - left).max(0.6);
            push(
                &mut body,
                format_args!(
                    "<rect x=\"{left:.2}\" y=\"{y:.1}\" width=\"{width:.2}\" height=\"{:.1}\" fill=\"{color}\">\
                     <title>{}</title></rect>\n",
                    LINE - 4.0,
                    escaped(&title)
                ),
            );
            if width > LETTER * stage.name.chars().count() as f64 + 4.0 {
                let (x, y) = (left + 3.0, y + 0.62 * LINE);
                push(
                    &mut body,
                    format_args!("<text class=\"n\" x=\"{x:.1}\" y=\"{y:.1}\">{}</text>\n", escaped(&stage.name)),
                );
            }
        }
        y += LINE;
    }
    let mut axis = String::new();
    let step = step_s(end_s);
    let mut tick = 0.0;
    while tick <= end_s {
        let at = x(tick);
        push(
            &mut axis,
            format_args!(
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"30\" y2=\"{y:.1}\" stroke=\"#ddd\"/>\
                 <text x=\"{at:.1}\" y=\"22\" text-anchor=\"middle\">{tick} s</text>\n"
            ),
        );
        tick += step;
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {:.0}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<style>.n{{font-size:11px;pointer-events:none}}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n{axis}{body}</svg>\n",
        y + 10.0
    )
}

/// Writing to a string does not fail.
fn push(text: &mut String, arguments: std::fmt::Arguments<'_>) {
    text.write_fmt(arguments).ok();
}

/// 1, 2 or 5 times a power of ten: about twelve ticks.
fn step_s(end_s: f64) -> f64 {
    let power = 10_f64.powf((end_s / 12.0).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * power).find(|step| end_s / step <= 14.0).unwrap_or(end_s)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
