//! Numbers that a kernel works on together, and roundings that become vector code.
//!
//! The kernels are plain loops over arrays, which the compiler turns into vector code once for
//! each instruction set that [`pulp::Arch`] knows; the processor's own is chosen at run time. Every operation is one of
//! IEEE 754 and none is fused or reordered, so that all of them give the same bits.

/// Points that go through a kernel together.
pub const LANES: usize = 16;
/// One value for each of them.
pub type Lane = [f32; LANES];

/// 2²³: adding it to a smaller number that is not negative leaves the number, rounded, in the low bits.
const ROUND: f32 = 8_388_608.0;
const ROUND_MASK: u32 = 0x7F_FFFF;
/// Numbers from 0 to below this can be rounded.
pub const MAX_ROUNDED: usize = 1 << 23;

/// The integer nearest to a number from 0 to 2²³.
#[inline(always)]
pub fn round_bits(x: f32) -> u32 {
    (x + ROUND).to_bits() & ROUND_MASK
}

/// The same as a number.
#[inline(always)]
pub fn round(x: f32) -> f32 {
    (x + ROUND) - ROUND
}

/// 1.5 · 2²³: adding it to a number within ±2²² leaves the number, rounded, in the low bits.
const ROUND_SIGNED: f32 = 12_582_912.0;

/// Largest integer not above x for x within ±2²²; for any other, one that lies beyond every volume. A cast would do the same
/// and saturate, which compilers turn into scalar code.
#[inline(always)]
pub fn floor(x: f32) -> i32 {
    let shifted = x + ROUND_SIGNED;
    let rounded = (shifted.to_bits() as i32).wrapping_sub(ROUND_SIGNED.to_bits() as i32);
    rounded - i32::from(shifted - ROUND_SIGNED > x)
}

/// The instruction sets that this processor has.
#[cfg(test)]
pub(crate) fn arch_levels() -> Vec<pulp::Arch> {
    use pulp::Arch;
    let mut levels = vec![Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        levels.extend(pulp::x86::V3::try_new().map(Arch::V3));
        levels.extend(pulp::x86::V4::try_new().map(Arch::V4));
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floor_is_exact_where_there_are_voxels_and_out_of_bounds_elsewhere() {
        for step in -40_000..40_000 {
            let x = step as f32 * 0.137;
            assert_eq!(floor(x), x.floor() as i32, "{x}");
        }
        for x in [-1.0, -0.0, 0.0, 0.5, -0.5, 1e-9, -1e-9, 4_000_000.5] {
            assert_eq!(floor(x), x.floor() as i32, "{x}");
        }
        for x in [
            5e6,
            -5e6,
            -12_582_912.0,
            1e30,
            -1e30,
            f32::INFINITY,
            f32::NEG_INFINITY,
            f32::NAN,
        ] {
            assert!(floor(x).unsigned_abs() > 1 << 22, "{x}");
        }
    }
}
