//! An image to draw on: lines, letters of 5 by 7 dots, other images.

/// Red, green, blue.
pub type Rgb = [u8; 3];

/// Dots of a letter are squares of this many pixels.
const DOT: usize = 2;
/// Dots from one letter to the next.
const ADVANCE: usize = 6;

/// An image under work.
#[derive(Debug, Clone)]
pub struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
}

impl Canvas {
    /// An image of one colour.
    pub fn new(width: usize, height: usize, color: Rgb) -> Self {
        Self { width, height, pixels: vec![color; width * height] }
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Pixels, row by row.
    pub fn pixels(&self) -> &[Rgb] {
        &self.pixels
    }

    /// Draws the pixels nearer than half of `thickness` to a segment.
    pub fn line(&mut self, a: (f64, f64), b: (f64, f64), thickness: f64, color: Rgb) {
        let reach = thickness / 2.0;
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let length2 = dx * dx + dy * dy;
        let bound = |low: f64, high: f64, side: usize| {
            let first = (low - reach).floor().max(0.0) as usize;
            first..((high + reach).ceil().max(0.0) as usize).min(side)
        };
        for y in bound(a.1.min(b.1), a.1.max(b.1), self.height) {
            for x in bound(a.0.min(b.0), a.0.max(b.0), self.width) {
                let (px, py) = (x as f64 + 0.5 - a.0, y as f64 + 0.5 - a.1);
                let t = if length2 > 0.0 { ((px * dx + py * dy) / length2).clamp(0.0, 1.0) } else { 0.0 };
                if (px - t * dx).hypot(py - t * dy) <= reach {
                    self.pixels[y * self.width + x] = color;
                }
            }
        }
    }

    /// Copies an image of `width` into this one; what does not fit is left out.
    pub fn image(&mut self, (left, top): (usize, usize), width: usize, pixels: &[Rgb]) {
        let shown = width.min(self.width.saturating_sub(left));
        for (row, line) in pixels.chunks_exact(width.max(1)).enumerate().take(self.height.saturating_sub(top)) {
            let at = (top + row) * self.width + left;
            self.pixels[at..at + shown].copy_from_slice(&line[..shown]);
        }
    }

    /// Width of a text, pixels.
    pub fn text_width(text: &str) -> f64 {
        (text.chars().count() * ADVANCE * DOT) as f64
    }

    /// Writes a text with its upper left corner at a place. Letters that are not in the set are blank.
    pub fn text(&mut self, (left, top): (f64, f64), text: &str, color: Rgb) {
        let (left, top) = (left.max(0.0) as usize, top.max(0.0) as usize);
        for (place, letter) in text.chars().enumerate() {
            for (row, bits) in glyph(letter).iter().enumerate() {
                for column in (0..5).filter(|column| bits >> (4 - column) & 1 == 1) {
                    for dot in 0..DOT * DOT {
                        let x = left + (place * ADVANCE + column) * DOT + dot % DOT;
                        let y = top + row * DOT + dot / DOT;
                        if x < self.width && y < self.height {
                            self.pixels[y * self.width + x] = color;
                        }
                    }
                }
            }
        }
    }
}

/// Rows of five dots, the leftmost the highest bit.
fn glyph(letter: char) -> [u8; 7] {
    match letter {
        '0' => [0x0e, 0x11, 0x13, 0x15, 0x19, 0x11, 0x0e],
        '1' => [0x04, 0x0c, 0x04, 0x04, 0x04, 0x04, 0x0e],
        '2' => [0x0e, 0x11, 0x01, 0x02, 0x04, 0x08, 0x1f],
        '3' => [0x1f, 0x02, 0x04, 0x02, 0x01, 0x11, 0x0e],
        '4' => [0x02, 0x06, 0x0a, 0x12, 0x1f, 0x02, 0x02],
        '5' => [0x1f, 0x10, 0x1e, 0x01, 0x01, 0x11, 0x0e],
        '6' => [0x06, 0x08, 0x10, 0x1e, 0x11, 0x11, 0x0e],
        '7' => [0x1f, 0x01, 0x02, 0x04, 0x08, 0x08, 0x08],
        '8' => [0x0e, 0x11, 0x11, 0x0e, 0x11, 0x11, 0x0e],
        '9' => [0x0e, 0x11, 0x11, 0x0f, 0x01, 0x02, 0x0c],
        '.' => [0, 0, 0, 0, 0, 0x0c, 0x0c],
        ',' => [0, 0, 0, 0, 0x0c, 0x04, 0x08],
        '-' => [0, 0, 0, 0x1f, 0, 0, 0],
        'B' => [0x1e, 0x11, 0x11, 0x1e, 0x11, 0x11, 0x1e],
        'N' => [0x11, 0x19, 0x15, 0x13, 0x11, 0x11, 0x11],
        'P' => [0x1e, 0x11, 0x11, 0x1e, 0x10, 0x10, 0x10],
        'R' => [0x1e, 0x11, 0x11, 0x1e, 0x14, 0x12, 0x11],
        'S' => [0x0f, 0x10, 0x10, 0x0e, 0x01, 0x01, 0x1e],
        'c' => [0, 0, 0x0e, 0x10, 0x10, 0x11, 0x0e],
        'd' => [0x01, 0x01, 0x0d, 0x13, 0x11, 0x11, 0x0f],
        'e' => [0, 0, 0x0e, 0x11, 0x1f, 0x10, 0x0e],
        'h' => [0x10, 0x10, 0x16, 0x19, 0x11, 0x11, 0x11],
        'i' => [0x04, 0, 0x0c, 0x04, 0x04, 0x04, 0x0e],
        'l' => [0x0c, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        'm' => [0, 0, 0x1a, 0x15, 0x15, 0x15, 0x15],
        'o' => [0, 0, 0x0e, 0x11, 0x11, 0x11, 0x0e],
        'p' => [0, 0, 0x1e, 0x11, 0x1e, 0x10, 0x10],
        'r' => [0, 0, 0x16, 0x19, 0x10, 0x10, 0x10],
        's' => [0, 0, 0x0e, 0x10, 0x0e, 0x01, 0x1e],
        't' => [0x08, 0x08, 0x1c, 0x08, 0x08, 0x09, 0x06],
        'u' => [0, 0, 0x11, 0x11, 0x11, 0x13, 0x0d],
        _ => [0; 7],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawing_beyond_the_border_draws_what_is_inside() {
        let mut canvas = Canvas::new(20, 10, [0; 3]);
        canvas.line((-5.0, 5.0), (30.0, 5.0), 2.0, [9; 3]);
        assert!((0..20).all(|x| canvas.pixels()[5 * 20 + x] == [9; 3]) && canvas.pixels()[0] == [0; 3]);
        canvas.text((15.0, 6.0), "0123", [1; 3]);
        canvas.image((18, 8), 4, &[[7; 3]; 16]);
        assert_eq!(canvas.pixels()[9 * 20 + 19], [7; 3]);
    }

    #[test]
    fn every_letter_of_the_labels_has_dots() {
        for letter in "held-out PSNR, dBprocessor time, s0123456789.".chars().filter(|c| *c != ' ') {
            assert_ne!(glyph(letter), [0; 7], "{letter}");
        }
    }
}
