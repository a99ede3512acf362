//! The decoder: a packet in, four images out.

use depth_camera::Image;
use pulp::Arch;
use rayon::prelude::*;

use crate::{
    HEIGHT, WIDTH,
    bilateral::{Bilateral, FilterRow},
    edges::EdgeRow,
    ir_parameters::{IrParameterError, IrParameters},
    options::{DecoderOptions, EdgeAwareOptions, OptionError},
    p0_tables::P0Tables,
    packet::RawPacket,
    phasors::{MeasureRow, PhasorRow, ReferenceRow},
    unwrap::{RayRow, UnwrapRow},
};

/// Rows that one task works on.
const TASK_ROWS: usize = 8;
/// Pixels that one task works on.
const TASK: usize = TASK_ROWS * WIDTH;

/// Why there is no decoder.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DecoderError {
    /// The camera makes no sense.
    #[error(transparent)]
    Camera(#[from] IrParameterError),
    /// The options make no sense.
    #[error(transparent)]
    Options(#[from] OptionError),
}

/// Turns raw packets of one device into depth and IR; holds what can be worked out before the first packet.
///
/// Rows are decoded in parallel on the rayon pool that the caller is in. The images are the same, bit for bit, for any
/// number of threads and on every instruction set.
#[derive(Debug)]
pub struct Decoder {
    options: DecoderOptions,
    arch: Arch,
    pixel_rad: f32,
    references: Vec<ReferenceRow>,
    rays: Vec<RayRow>,
}

impl Decoder {
    /// A decoder for the device that these tables and parameters were read from.
    ///
    /// # Errors
    /// [`DecoderError`] naming parameter or option, value and bound.
    pub fn new(
        tables: &P0Tables,
        camera: &IrParameters,
        options: DecoderOptions,
    ) -> Result<Self, DecoderError> {
        camera.validate()?;
        options.validate()?;
        let rows = (0..HEIGHT).into_par_iter();
        let rays = rows.clone().map(|v| RayRow::new(camera, v, &options));
        let references = rows.map(|v| ReferenceRow::new(tables, v, &options));
        Ok(Decoder {
            options,
            arch: Arch::new(),
            pixel_rad: (1.0 / camera.fx) as f32,
            references: references.collect(),
            rays: rays.collect(),
        })
    }

    /// Decodes a packet into `decoded`, all of which is overwritten; allocates nothing but at its first use of
    /// `decoded`.
    pub fn decode(&self, packet: RawPacket<'_>, decoded: &mut Decoded) {
        match &self.options.bilateral {
            Some(filter) => {
                let filter = Bilateral::new(filter, &self.options);
                self.measure(packet, decoded);
                self.smooth_and_unwrap(filter, decoded);
            }
            None => self.measure_and_unwrap(packet, decoded),
        }
        if let Some(options) = &self.options.edge_aware {
            self.take_out_edges(options, decoded);
        }
    }

    /// From packet to depth, a row at a time.
    fn measure_and_unwrap(&self, packet: RawPacket<'_>, decoded: &mut Decoded) {
        let depth = decoded.depth.data_mut().par_chunks_mut(TASK);
        let sigma = decoded.depth_sigma.data_mut().par_chunks_mut(TASK);
        let ir = decoded.ir.data_mut().par_chunks_mut(TASK);
        let ambient = decoded.ambient.data_mut().par_chunks_mut(TASK);
        let tasks = depth.zip(sigma).zip(ir).zip(ambient).enumerate();
        tasks.for_each(|(task, (((depth, sigma), ir), ambient))| {
            let mut phasors = PhasorRow::ZERO;
            let depth = depth.chunks_exact_mut(WIDTH);
            let sigma = sigma.chunks_exact_mut(WIDTH);
            let (ir, _) = ir.as_chunks_mut();
            let (ambient, _) = ambient.as_chunks_mut();
            let rows = depth.zip(sigma).zip(ir).zip(ambient);
            for (v, (((depth, sigma_m), ir), ambient)) in (TASK_ROWS * task..).zip(rows) {
                self.measure_row(packet, v, (&mut phasors, ir, ambient));
                self.unwrap_row(v, &phasors, &[1.0; WIDTH], (depth, sigma_m));
            }
        });
    }

    /// From packet to phasors, IR and ambient light.
    fn measure(&self, packet: RawPacket<'_>, decoded: &mut Decoded) {
        decoded.phasors.resize(HEIGHT, PhasorRow::ZERO);
        let phasors = decoded.phasors.par_chunks_mut(TASK_ROWS);
        let ir = decoded.ir.data_mut().par_chunks_mut(TASK);
        let ambient = decoded.ambient.data_mut().par_chunks_mut(TASK);
        let tasks = phasors.zip(ir).zip(ambient).enumerate();
        tasks.for_each(|(task, ((phasors, ir), ambient))| {
            let (ir, _) = ir.as_chunks_mut();
            let (ambient, _) = ambient.as_chunks_mut();
            let rows = phasors.iter_mut().zip(ir).zip(ambient);
            for (v, ((phasors, ir), ambient)) in (TASK_ROWS * task..).zip(rows) {
                self.measure_row(packet, v, (phasors, ir, ambient));
            }
        });
    }

    /// From phasors to depth through the bilateral filter.
    fn smooth_and_unwrap(&self, filter: Bilateral, decoded: &mut Decoded) {
        let rows = &decoded.phasors;
        let depth = decoded.depth.data_mut().par_chunks_mut(TASK);
        let sigma = decoded.depth_sigma.data_mut().par_chunks_mut(TASK);
        let tasks = depth.zip(sigma).enumerate();
        tasks.for_each(|(task, (depth, sigma))| {
            let mut filtered = PhasorRow::ZERO;
            let mut variance_left = [1.0; WIDTH];
            let images = depth
                .chunks_exact_mut(WIDTH)
                .zip(sigma.chunks_exact_mut(WIDTH));
            for (v, images) in (TASK_ROWS * task..).zip(images) {
                self.arch.dispatch(FilterRow {
                    filter,
                    rows: [v.wrapping_sub(1), v, v + 1]
                        .map(|v| rows.get(v).unwrap_or(&PhasorRow::ZERO)),
                    filtered: &mut filtered,
                    variance_left: &mut variance_left,
                });
                self.unwrap_row(v, &filtered, &variance_left, images);
            }
        });
    }

    /// Filters the depth that is there.
    fn take_out_edges(&self, options: &EdgeAwareOptions, decoded: &mut Decoded) {
        decoded
            .unfiltered_depth
            .resize(WIDTH * HEIGHT, Default::default());
        decoded
            .unfiltered_depth
            .copy_from_slice(decoded.depth.data());
        let from = &decoded.unfiltered_depth;
        let depth = decoded.depth.data_mut().par_chunks_mut(TASK);
        let sigma = decoded.depth_sigma.data_mut().par_chunks_mut(TASK);
        let tasks = depth.zip(sigma).enumerate();
        tasks.for_each(|(task, (depth, sigma))| {
            let images = depth
                .chunks_exact_mut(WIDTH)
                .zip(sigma.chunks_exact_mut(WIDTH));
            for (v, (depth, sigma_m)) in (TASK_ROWS * task..).zip(images) {
                let row = |v: usize| from.get(v * WIDTH..(v + 1) * WIDTH);
                let above = v.checked_sub(1).and_then(row);
                self.arch.dispatch(EdgeRow {
                    options,
                    pixel_rad: self.pixel_rad,
                    rows: [above, row(v), row(v + 1)].map(|row| row.unwrap_or(&[0.0; WIDTH])),
                    depth,
                    sigma_m,
                });
            }
        });
    }

    #[inline(always)]
    fn measure_row(
        &self,
        packet: RawPacket<'_>,
        v: usize,
        (phasors, ir, ambient): (&mut PhasorRow, &mut [u16; WIDTH], &mut [i16; WIDTH]),
    ) {
        self.arch.dispatch(MeasureRow {
            packet,
            v,
            unmirrored: self.options.unmirrored,
            reference: &self.references[v],
            phasors,
            ir,
            ambient,
        });
    }

    #[inline(always)]
    fn unwrap_row(
        &self,
        v: usize,
        phasors: &PhasorRow,
        variance_left: &[f32; WIDTH],
        (depth, sigma_m): (&mut [f32], &mut [f32]),
    ) {
        self.arch.dispatch(UnwrapRow {
            phasors,
            variance_left,
            rays: &self.rays[v],
            options: &self.options,
            depth,
            sigma_m,
        });
    }
}

/// What a packet holds, and the memory to work it out; kept from packet to packet.
#[derive(Clone, Debug)]
pub struct Decoded {
    depth: Image<f32>,
    ir: Image<u16>,
    depth_sigma: Image<f32>,
    ambient: Image<i16>,
    /// Of the bilateral filter; empty without.
    phasors: Vec<PhasorRow>,
    /// Of the edge-aware filter; empty without.
    unfiltered_depth: Vec<f32>,
}

impl Default for Decoded {
    fn default() -> Self {
        Decoded {
            depth: Image::filled(WIDTH, HEIGHT, 0.0),
            ir: Image::filled(WIDTH, HEIGHT, 0),
            depth_sigma: Image::filled(WIDTH, HEIGHT, f32::INFINITY),
            ambient: Image::filled(WIDTH, HEIGHT, 0),
            phasors: Vec::new(),
            unfiltered_depth: Vec::new(),
        }
    }
}

impl Decoded {
    /// Depth along the optical axis, metres; 0 is no measurement.
    pub fn depth(&self) -> &Image<f32> {
        &self.depth
    }

    /// IR counts: 16 times the mean amplitude of the three frequencies, 65 535 where an exposure was saturated, 0 in the
    /// outermost columns. Never filtered.
    pub fn ir(&self) -> &Image<u16> {
        &self.ir
    }

    /// The confidence of depth: its standard deviation as predicted from the signal's amplitude, the assumed noise of an
    /// exposure and what the bilateral filter left of it, metres; infinite where there is no depth.
    pub fn depth_sigma(&self) -> &Image<f32> {
        &self.depth_sigma
    }

    /// The tenth sub-image, linear counts: said to be exposed without the emitters. 32 767 is saturated; 0 in the outermost
    /// columns.
    pub fn ambient(&self) -> &Image<i16> {
        &self.ambient
    }

    /// Takes depth and IR out and puts others in their place, to be decoded into whatever they hold.
    ///
    /// # Panics
    /// If these are not of the sensor's size.
    pub(crate) fn exchange(
        &mut self,
        depth: Image<f32>,
        ir: Image<u16>,
    ) -> (Image<f32>, Image<u16>) {
        let is_whole = |pixels: usize| pixels == WIDTH * HEIGHT;
        assert!(is_whole(depth.data().len()) && is_whole(ir.data().len()));
        (
            std::mem::replace(&mut self.depth, depth),
            std::mem::replace(&mut self.ir, ir),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{P0_RESPONSE_BYTES, PACKET_BYTES, ir_parameters::tests::typical};

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let mut random = fastrand::Rng::with_seed(11);
        let mut random_bytes = |n| (0..n).map(|_| random.u8(..)).collect::<Vec<_>>();
        let tables = P0Tables::from_response(&random_bytes(P0_RESPONSE_BYTES)).unwrap();
        let bytes = random_bytes(PACKET_BYTES);
        let packet = RawPacket::new(&bytes).unwrap();
        let options = DecoderOptions::default().with_filters();
        let mut decoder = Decoder::new(&tables, &typical(), options).unwrap();
        let mut decode_with = |arch| {
            decoder.arch = arch;
            let mut decoded = Decoded::default();
            decoder.decode(packet, &mut decoded);
            decoded
        };
        let scalar = decode_with(Arch::Scalar);
        let mut levels = vec![Arch::new()];
        #[cfg(target_arch = "x86_64")]
        levels.extend(pulp::x86::V3::try_new().map(Arch::V3));
        assert!(scalar.depth.data().iter().any(|&z| z > 0.0));
        for arch in levels {
            let other = decode_with(arch);
            assert_eq!(scalar.depth, other.depth);
            assert_eq!(scalar.depth_sigma, other.depth_sigma);
            assert_eq!((&scalar.ir, &scalar.ambient), (&other.ir, &other.ambient));
        }
    }
}
