//! The flame graph: a bar for each function within its caller, as wide as the share of samples that saw it; threads at the top.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::stacks::Stacks;

/// Pixels: of the picture, of a line, of a letter.
const WIDTH: f64 = 1400.0;
const LINE: f64 = 17.0;
const LETTER: f64 = 6.4;
/// Bars narrower than this are left out, pixels.
const LEAST: f64 = 0.4;

/// A function within its caller.
#[derive(Default)]
struct Node<'a> {
    count: u64,
    inner: BTreeMap<&'a str, Node<'a>>,
}

pub(super) fn draw(stacks: &Stacks, title: &str) -> String {
    let mut root = Node::default();
    for (stack, count) in stacks.iter() {
        let mut node = &mut root;
        node.count += count;
        for function in stack {
            node = node.inner.entry(function).or_default();
            node.count += count;
        }
    }
    let mut body = String::new();
    let depth = draw_inner(&mut body, &root, (10.0, 40.0), root.count);
    let height = 40.0 + LINE * (depth + 1) as f64;
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height:.0}\" font-family=\"monospace\" \
         font-size=\"11\">\n<style>rect{{stroke:white;stroke-width:.5}}text{{pointer-events:none}}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n<text x=\"10\" y=\"22\" font-size=\"14\">{} ({} samples)</text>\n\
         {body}</svg>\n",
        escaped(title),
        root.count
    )
}

/// Draws what is within a node; how many lines deep that is.
fn draw_inner(body: &mut String, node: &Node<'_>, (mut x, y): (f64, f64), all: u64) -> usize {
    let mut deepest = 0;
    for (name, inner) in &node.inner {
        let width = (WIDTH - 20.0) * inner.count as f64 / all.max(1) as f64;
        if width >= LEAST {
            let share = 100.0 * inner.count as f64 / all.max(1) as f64;
            let letters = (width / LETTER) as usize;
            let shown: String = if letters < 3 { String::new() } else { name.chars().take(letters - 1).collect() };
            // Writing to a string does not fail.
            writeln!(
                body,
                "<rect x=\"{x:.1}\" y=\"{y:.0}\" width=\"{width:.1}\" height=\"{:.0}\" fill=\"{}\"><title>{}: {share:.1} %, {} \
                 samples</title></rect><text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                LINE - 1.0,
                color(name),
                escaped(name),
                inner.count,
                x + 2.0,
                y + 12.0,
                escaped(&shown)
            )
            .ok();
            deepest = deepest.max(1 + draw_inner(body, inner, (x, y + LINE), all));
        }
        x += width;
    }
    deepest
}

/// Warm colours, the same for the same crate.
fn color(name: &str) -> String {
    let origin = name.trim_start_matches(['<', '&']).split("::").next().unwrap_or(name);
    let hash = origin.bytes().fold(7_u32, |hash, byte| hash.wrapping_mul(31).wrapping_add(u32::from(byte)));
    format!("hsl({},{}%,{}%)", 10 + hash % 50, 65 + hash / 50 % 25, 62 + hash / 1250 % 15)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::super::stacks::read;
    use super::*;

    #[test]
    fn bars_are_as_wide_as_their_share_and_lie_below_their_callers() {
        let sample = |functions: &[&str]| {
            let frames: String = functions.iter().rev().map(|name| format!("\t 1f {name}\n")).collect();
            format!("work  7\n{frames}\n")
        };
        let script = [sample(&["main", "a<b>"]), sample(&["main", "a<b>"]), sample(&["main", "c"]), sample(&["main"])];
        let picture = draw(&read(&script.concat()), "a & b");
        assert!(picture.starts_with("<svg") && picture.contains("a &amp; b (4 samples)"), "{picture}");
        assert!(picture.contains("a&lt;b&gt;: 50.0 %, 2 samples") && !picture.contains("a<b>"), "{picture}");
        let bar = |name: &str| {
            let line = picture.lines().find(|line| line.contains(&format!("<title>{name}"))).expect("a bar");
            let number = |key: &str| -> f64 {
                line.split_once(&format!(" {key}=\""))
                    .expect("there")
                    .1
                    .split('"')
                    .next()
                    .expect("a number")
                    .parse()
                    .expect("one")
            };
            (number("y"), number("width"))
        };
        let ((top, whole), (below, half)) = (bar("main"), bar("a&lt;b&gt;"));
        assert!(below > top && (2.0 * half - whole).abs() < 0.2, "{picture}");
    }
}
