//! Estimates the time per request and per register of a device, from measured round trips. `plan::by_cost` decides
//! from them which gaps are read.

/// The number of answers that an estimate requires.
const MIN_SAMPLES: u32 = 100;

/// Milliseconds per request and per register of a device that is not measured yet. They read gaps of up
/// to 10.
pub const UNMEASURED_COST_MS: (f64, f64) = (10.0, 1.0);

/// Linear regression of round trip time by size: a constant per request, and a slope per 16 bits.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Samples {
    count: u32,
    sum_size: f64,
    sum_time: f64,
    sum_size_squared: f64,
    sum_product: f64,
}

impl Samples {
    /// Adds an answer of `size` registers, or 16-bit groups of bits, that took `time` milliseconds.
    pub(super) fn add(&mut self, size: f64, time: f64) {
        self.count += 1;
        self.sum_size += size;
        self.sum_time += time;
        self.sum_size_squared += size * size;
        self.sum_product += size * time;
    }

    /// Milliseconds per request and per register, once there are enough samples. Answers of one
    /// size do not show the cost of a register: `before` is used then.
    pub(super) fn cost(&self, before: f64) -> Option<(f64, f64)> {
        if self.count < MIN_SAMPLES {
            return None;
        }
        let count = f64::from(self.count);
        let spread = self.sum_size_squared - self.sum_size * self.sum_size / count;
        let together = self.sum_product - self.sum_size * self.sum_time / count;
        let item = if spread > count / 100.0 { (together / spread).max(0.0) } else { before };
        let request = (self.sum_time - item * self.sum_size) / count;
        Some((request.max(0.0), item))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cost_is_estimated_from_the_answers() {
        let mut samples = Samples::default();
        for index in 0..MIN_SAMPLES {
            assert_eq!(samples.cost(9.0), None);
            let size = f64::from(index % 10 + 1);
            samples.add(size, 5.0 + 0.25 * size);
        }
        let (request, item) = samples.cost(9.0).unwrap();
        assert!((request - 5.0).abs() < 1e-9 && (item - 0.25).abs() < 1e-9, "{request} {item}");
    }

    #[test]
    fn answers_of_one_size_do_not_change_the_cost_of_registers() {
        let mut samples = Samples::default();
        for _ in 0..MIN_SAMPLES {
            samples.add(10.0, 7.0);
        }
        assert_eq!(samples.cost(0.2), Some((5.0, 0.2)));
    }

    #[test]
    fn a_cost_is_never_negative() {
        let mut samples = Samples::default();
        for index in 0..MIN_SAMPLES {
            let size = f64::from(index % 2 * 100 + 1);
            samples.add(size, 10.0 - size / 20.0);
        }
        assert!(samples.cost(0.0).is_some_and(|(request, item)| request >= 0.0 && item == 0.0));
    }
}
