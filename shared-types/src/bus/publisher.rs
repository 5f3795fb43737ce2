//! The sending end of a channel.

use std::rc::Rc;

use iceoryx2::port::LoanError;
use iceoryx2::service::port_factory::PortFactory as _;

use super::error::BusError;
use super::message::{Envelope, Framed, seal};
use super::wait::Notifier;
use super::{Factory, Served};
use crate::channel::Channel;
use crate::service::ServiceName;

/// Sends on a channel.
pub struct Publisher<C: Channel> {
    raw: Rc<Served<C>>,
    factory: Factory<C>,
    notifier: Option<Notifier>,
    sender: ServiceName,
    incarnation: u64,
    sequence: u64,
    limit: usize,
}

impl<C: Channel> core::fmt::Debug for Publisher<C> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Publisher").field("channel", &C::NAME).field("sequence", &self.sequence).finish_non_exhaustive()
    }
}

impl<C: Channel> Publisher<C> {
    pub(super) fn new(
        raw: Rc<Served<C>>,
        factory: Factory<C>,
        notifier: Option<Notifier>,
        sender: ServiceName,
        incarnation: u64,
        limit: usize,
    ) -> Self {
        Self { raw, factory, notifier, sender, incarnation, sequence: 0, limit }
    }

    /// Sends a message without items.
    ///
    /// # Errors
    /// [`BusError::NoChunk`] when readers hold every chunk, [`BusError::Send`] otherwise.
    pub fn send(&mut self, now_ns: u64, stamp_ns: u64, header: &C::Header) -> Result<(), BusError> {
        self.send_with(now_ns, stamp_ns, header, 0, |_| ())
    }

    /// Sends a message with a copy of the items.
    ///
    /// # Errors
    /// As [`Self::send_with`].
    pub fn send_items(
        &mut self,
        now_ns: u64,
        stamp_ns: u64,
        header: &C::Header,
        items: &[C::Item],
    ) -> Result<(), BusError> {
        self.send_with(now_ns, stamp_ns, header, items.len(), |loan| loan.copy_from_slice(items))
    }

    /// Sends a message whose `len` items are written in place: they are zero when `fill` gets them.
    ///
    /// # Errors
    /// [`BusError::TooManyItems`], [`BusError::NoChunk`] when readers hold every chunk, [`BusError::Send`] otherwise.
    pub fn send_with(
        &mut self,
        now_ns: u64,
        stamp_ns: u64,
        header: &C::Header,
        len: usize,
        fill: impl FnOnce(&mut [C::Item]),
    ) -> Result<(), BusError> {
        let envelope = Envelope { stamp_ns, sent_ns: now_ns, ..Envelope::default() };
        self.send_enveloped(envelope, header, len, fill)
    }

    pub(super) fn send_enveloped(
        &mut self,
        mut envelope: Envelope,
        header: &C::Header,
        len: usize,
        fill: impl FnOnce(&mut [C::Item]),
    ) -> Result<(), BusError> {
        envelope.sequence = self.sequence;
        envelope.incarnation = self.incarnation;
        envelope.sender = self.sender.code();
        self.write(len, fill, |items| {
            envelope.seal = seal::<C>(&envelope, header, items);
            Framed { envelope, header: *header }
        })?;
        self.sequence += 1;
        Ok(())
    }

    /// Writes a message in place: the items first, then what goes before them.
    fn write(
        &mut self,
        len: usize,
        fill: impl FnOnce(&mut [C::Item]),
        frame: impl FnOnce(&[C::Item]) -> Framed<C::Header>,
    ) -> Result<(), BusError> {
        if len > self.limit {
            return Err(BusError::TooManyItems { channel: C::NAME, items: len, limit: self.limit });
        }
        let mut loan = self.raw.0.loan_slice_uninit(len).map_err(|cause| match cause {
            LoanError::OutOfMemory | LoanError::ExceedsMaxLoans => BusError::NoChunk { channel: C::NAME },
            other => BusError::Send { channel: C::NAME, cause: format!("{other:?}") },
        })?;
        let uninitialised = loan.payload_mut();
        #[expect(unsafe_code, reason = "the loan is filled in place instead of copied")]
        // SAFETY: the pointer and length are those of the loan's own slice; all bytes are zeroed before a reference to
        // initialised items is made, and zero is a valid value of every `Pod` item.
        let items = unsafe {
            core::ptr::write_bytes(uninitialised.as_mut_ptr(), 0, uninitialised.len());
            core::slice::from_raw_parts_mut(uninitialised.as_mut_ptr().cast::<C::Item>(), uninitialised.len())
        };
        fill(items);
        *loan.user_header_mut() = frame(items);
        #[expect(unsafe_code, reason = "the loan is filled in place instead of copied")]
        // SAFETY: every item was initialised above.
        let loan = unsafe { loan.assume_init() };
        crate::fault_point::reach("loan", C::NAME);
        loan.send().map_err(|cause| BusError::Send { channel: C::NAME, cause: format!("{cause:?}") })?;
        if let Some(notifier) = &self.notifier {
            notifier.notify();
        }
        Ok(())
    }

    /// Sends what no service would: an envelope as it is given, without a seal. For tests of what readers do with it.
    ///
    /// # Errors
    /// As [`Self::send_with`].
    #[doc(hidden)]
    pub fn send_wild(&mut self, envelope: Envelope, header: &C::Header, items: &[C::Item]) -> Result<(), BusError> {
        self.send_framed(envelope, header, items)
    }

    /// Sends a copy of the items with an envelope as it is given.
    pub(super) fn send_framed(
        &mut self,
        envelope: Envelope,
        header: &C::Header,
        items: &[C::Item],
    ) -> Result<(), BusError> {
        self.write(items.len(), |to| to.copy_from_slice(items), |_| Framed { envelope, header: *header })
    }

    /// Readers that the channel has now: nothing need be made for nobody.
    #[must_use]
    pub fn readers(&self) -> usize {
        self.factory.dynamic_config().number_of_subscribers()
    }

    /// Messages sent so far.
    #[must_use]
    pub fn sent(&self) -> u64 {
        self.sequence
    }
}
