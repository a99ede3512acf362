//! The thread that owns the library: opens the device, streams, obeys commands, watches for silence, and looks for the device
//! again when it has gone.

use std::{
    cell::{Cell, RefCell},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, Sender, TryRecvError};
use depth_camera::CameraError;
use udev_monitor::UsbMonitor;

use crate::{
    announcements::Announcements,
    assembly::{Assembler, Captured, Silence},
    context::{Context, newest_warning},
    device::Device,
    exchange::{Command, Event, Identity, Outlet, Shared},
    streams::Streams,
    supervision::Activity,
};

/// How long one look for events waits: packets come every 2 ms, commands must not wait much longer.
const PUMP_TIMEOUT: Duration = Duration::from_millis(10);

/// A stream that brings nothing for so long will not: the slowest, IR at full size, has 10 frames a second.
const SILENCE_LIMIT: Duration = Duration::from_secs(2);

/// A turn takes as long as pumping and a command; where it took longer the process was stopped.
const AWAY: Duration = Duration::from_secs(1);

/// How long one wait for the word of a device that has gone lasts: commands must not wait much longer.
const LISTEN_INTERVAL: Duration = Duration::from_millis(20);

/// How a time with an open device ended.
enum End {
    Stopped,
    NotOpened(CameraError),
    /// A stream has not come since the device was opened.
    Silent(CameraError),
    Failed(CameraError),
}

/// What commands came to.
#[derive(PartialEq, Eq)]
enum Obeyed {
    Go,
    Stop,
}

/// The thread's state.
#[derive(Debug)]
pub(crate) struct DeviceThread {
    /// Which device; any, until one has been opened.
    pub(crate) serial: RefCell<Option<String>>,
    pub(crate) streams: Cell<Streams>,
    pub(crate) ir_gain: Cell<u16>,
    pub(crate) shared: Arc<Shared>,
    pub(crate) commands: Receiver<Command>,
    pub(crate) outlet: Outlet,
    pub(crate) assembler: RefCell<Assembler>,
    /// What is said of devices that come.
    pub(crate) announcements: RefCell<Announcements>,
    /// How often a device that has gone is looked for though nothing is said.
    pub(crate) search_interval: Duration,
}

impl DeviceThread {
    /// Runs until told to stop, or until the device fails in another way than by being unplugged or falling silent after its streams
    /// had come. `opened` hears of the first attempt to open it.
    pub(crate) fn run(self, opened: &Sender<Result<Identity, CameraError>>) {
        let tell_opened = |identity| drop(opened.try_send(Ok(identity)));
        let mut end = self.session(&tell_opened);
        if let End::NotOpened(error) = end {
            drop(opened.try_send(Err(error)));
            return;
        }
        while let End::Failed(error) | End::Silent(error) = end {
            let may_return = error == CameraError::Disconnected;
            self.outlet.offer(Event::Failed(error), &self.shared);
            if !may_return {
                return;
            }
            end = self.resume();
        }
    }

    /// Looks for the device until it streams again, and takes its streams.
    fn resume(&self) -> End {
        let mut next_look = Instant::now();
        loop {
            self.shared.heartbeat.enter(Activity::Searching);
            let is_announced = self.announcements.borrow_mut().wait(LISTEN_INTERVAL);
            if self.obey_without_device() == Obeyed::Stop {
                return End::Stopped;
            }
            if !is_announced && Instant::now() < next_look {
                continue;
            }
            // It may be there before the system has set its permissions, before its other parts, or before it can stream: try again.
            match self.session(&|_| ()) {
                End::NotOpened(_) | End::Silent(_) => {
                    next_look = Instant::now() + self.search_interval;
                }
                end => return end,
            }
        }
    }

    /// Keeps in mind what is asked for while the device is gone.
    fn obey_without_device(&self) -> Obeyed {
        loop {
            match self.commands.try_recv() {
                Err(TryRecvError::Empty) => return Obeyed::Go,
                Ok(Command::Stop) | Err(TryRecvError::Disconnected) => return Obeyed::Stop,
                Ok(Command::Streams(streams, answer)) => {
                    self.streams.set(streams);
                    drop(answer.try_send(Err(CameraError::Disconnected)));
                }
                Ok(Command::IrGain(gain, answer)) => {
                    self.ir_gain.set(gain);
                    drop(answer.try_send(Err(CameraError::Disconnected)));
                }
                Ok(Command::Listen(monitor)) => self.listen_to(monitor),
            }
        }
    }

    fn listen_to(&self, monitor: UsbMonitor) {
        self.announcements.borrow_mut().listen_to(monitor);
    }

    /// One time with an open device.
    fn session(&self, opened: &dyn Fn(Identity)) -> End {
        let emit = |captured| {
            self.outlet.offer(Event::Captured(captured), &self.shared);
        };
        let context = match Context::new() {
            Ok(context) => context,
            Err(error) => return End::NotOpened(error),
        };
        let device = match self.open(&context, &emit) {
            Ok((device, identity)) => {
                opened(identity);
                device
            }
            Err(error) => return End::NotOpened(error),
        };
        let end = self.stream(&context, &device);
        self.shared.depth_runs.store(false, Ordering::Relaxed);
        // What has fallen silent may answer late, also to being stopped and closed.
        self.shared.heartbeat.begin_return();
        drop(device);
        self.publish();
        end
    }

    fn open<'a>(
        &'a self,
        context: &'a Context,
        emit: &'a dyn Fn(Captured),
    ) -> Result<(Device<'a>, Identity), CameraError> {
        let heartbeat = &self.shared.heartbeat;
        let chosen = self.serial.borrow().clone();
        let serial = match chosen {
            Some(serial) => serial,
            None => first_serial(context)?,
        };
        let device = Device::open(context, &serial, &self.assembler, heartbeat, emit)?;
        let zero_plane = device.zero_plane();
        zero_plane.validate()?;
        self.set_ir_gain(&device, self.ir_gain.get())?;
        self.assembler.borrow_mut().device_opened();
        self.apply(&device, self.streams.get())?;
        self.serial.replace(Some(serial.clone()));
        Ok((device, Identity { serial, zero_plane }))
    }

    fn stream(&self, context: &Context, device: &Device<'_>) -> End {
        let heartbeat = &self.shared.heartbeat;
        let mut turn = Instant::now();
        let mut awake_since = turn;
        let mut have_come = false;
        // In this order: what went before may have taken long.
        heartbeat.enter(Activity::Streaming);
        heartbeat.end_return();
        loop {
            heartbeat.enter(Activity::Streaming);
            if let Err(error) = context.pump(PUMP_TIMEOUT) {
                return End::Failed(error);
            }
            let now = Instant::now();
            if now - turn > AWAY {
                awake_since = now;
            }
            turn = now;
            have_come = have_come || self.have_come();
            match self.watch(awake_since) {
                Ok(()) => {}
                // As after a stall of the bus: opened again, they come again.
                Err(_) if have_come => return End::Failed(CameraError::Disconnected),
                Err(error) => return End::Silent(error),
            }
            self.publish();
            match self.obey(device) {
                Ok(Obeyed::Go) => {}
                Ok(Obeyed::Stop) => return End::Stopped,
                Err(error) => return End::Failed(error),
            }
        }
    }

    /// Does what it is told.
    fn obey(&self, device: &Device<'_>) -> Result<Obeyed, CameraError> {
        loop {
            match self.commands.try_recv() {
                Err(TryRecvError::Empty) => return Ok(Obeyed::Go),
                // The camera was dropped, or never came to be because opening took too long.
                Ok(Command::Stop) | Err(TryRecvError::Disconnected) => return Ok(Obeyed::Stop),
                Ok(Command::Streams(streams, answer)) => {
                    let obeyed = self.apply(device, streams);
                    drop(answer.try_send(obeyed.clone()));
                    obeyed?;
                }
                Ok(Command::IrGain(gain, answer)) => {
                    let obeyed = self.set_ir_gain(device, gain);
                    drop(answer.try_send(obeyed.clone()));
                    obeyed?;
                }
                Ok(Command::Listen(monitor)) => self.listen_to(monitor),
            }
        }
    }

    /// Stops what is not wanted, video before depth, then starts what is.
    fn apply(&self, device: &Device<'_>, streams: Streams) -> Result<(), CameraError> {
        self.streams.set(streams);
        if device.ir_runs() != streams.ir() {
            device.stop_ir();
        }
        if !streams.depth() {
            device.stop_depth();
        }
        self.shared
            .depth_runs
            .store(streams.depth(), Ordering::Relaxed);
        if streams.depth() {
            device.start_depth()?;
        }
        match streams.ir() {
            Some(size) => device.start_ir(size),
            None => Ok(()),
        }
    }

    fn set_ir_gain(&self, device: &Device<'_>, gain: u16) -> Result<u16, CameraError> {
        self.ir_gain.set(gain);
        let read_back = device.set_ir_gain(gain)?;
        self.shared
            .ir_gain
            .store(read_back.into(), Ordering::Relaxed);
        Ok(read_back)
    }

    /// Whether a stream that runs has been silent for too long; nobody listened while the process itself was stopped.
    fn watch(&self, awake_since: Instant) -> Result<(), CameraError> {
        let now = Instant::now();
        if now - awake_since <= SILENCE_LIMIT {
            return Ok(());
        }
        let assembler = self.assembler.borrow();
        check_silence("depth", assembler.depth_silence(now))?;
        check_silence("IR", assembler.ir_silence(now))
    }

    /// Whether every stream that runs has brought something since it was started.
    fn have_come(&self) -> bool {
        let (now, assembler) = (Instant::now(), self.assembler.borrow());
        let running = [assembler.depth_silence(now), assembler.ir_silence(now)];
        running.iter().flatten().all(|silence| !silence.is_first)
    }

    fn publish(&self) {
        self.shared.publish(self.assembler.borrow().statistics());
    }
}

fn first_serial(context: &Context) -> Result<String, CameraError> {
    let first = context.serials()?.into_iter().next();
    match first {
        Some(serial) => Ok(serial),
        None if context.n_cameras()? > 0 => Err(CameraError::PermissionDenied),
        None => Err(CameraError::Disconnected),
    }
}

fn check_silence(stream: &str, silence: Option<Silence>) -> Result<(), CameraError> {
    let Some(silence) = silence.filter(|silence| silence.silent_for > SILENCE_LIMIT) else {
        return Ok(());
    };
    let secs = silence.silent_for.as_secs_f64();
    let since = if silence.is_first {
        "its start"
    } else {
        "the last one"
    };
    Err(CameraError::Unresponsive(format!(
        "no {stream} frame within {secs:.1} s of {since}{}",
        newest_warning()
    )))
}
