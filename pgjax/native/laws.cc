// What XLA calls: one library per precision (PGJAX_DOUBLE). Every array holds one row of numbers
// per particle; `laws.h` says which.
#include "laws.h"

#include "xla.h"

using namespace pgjax;

namespace {

template <class Buffer>
int numbers(const Buffer& buffer) {
  const auto dimensions = buffer.dimensions();
  int size = 1;
  for (std::size_t i = 1; i < dimensions.size(); ++i) size *= int(dimensions[i]);
  return size;
}
Column<const T> column(In& a) { return {a.typed_data(), numbers(a)}; }
Column<T> column(Out& a) { return {a->typed_data(), numbers(*a)}; }

// H and two numbers in.
template <int NumberOut, class F, class... Outs>
ffi::Error law(ffi::ThreadPool threads, const F& one, In& H, In& mu, In& lam, Outs&... made) {
  Pool pool = pool_of(threads);
  const Column<const T> ins[] = {column(H), column(mu), column(lam)};
  const Column<T> outs[] = {column(made)...};
  for_each_block<T, 11, NumberOut>(H.dimensions()[0], ins, outs, pool, one);
  return ffi::Error::Success();
}

using V = Group<T>;

ffi::Error NeoHookean(ffi::ThreadPool threads, In H, In mu, In lam, Out tau, Out change) {
  return law<10>(threads, neo_hookean<V>, H, mu, lam, tau, change);
}
ffi::Error FixedCorotated(ffi::ThreadPool threads, In H, In mu, In lam, Out tau, Out change) {
  return law<10>(threads, fixed_corotated<V>, H, mu, lam, tau, change);
}
ffi::Error StVKHencky(ffi::ThreadPool threads, In H, In mu, In lam, Out tau, Out change,
                      Out smallest) {
  return law<11>(threads, stvk_hencky<V>, H, mu, lam, tau, change, smallest);
}

ffi::Error VonMises(ffi::ThreadPool threads, In H, In tau_Y, In mu, Out mapped, Out increment) {
  return law<10>(threads, von_mises<V>, H, tau_Y, mu, mapped, increment);
}

ffi::Error DruckerPrager(ffi::ThreadPool threads, In H, In slope, In apex, In gained, Out mapped,
                         Out history) {
  Pool pool = pool_of(threads);
  const Column<const T> ins[] = {column(H), column(slope), column(apex), column(gained)};
  const Column<T> outs[] = {column(mapped), column(history)};
  for_each_block<T, 12, 10>(H.dimensions()[0], ins, outs, pool, drucker_prager<V>);
  return ffi::Error::Success();
}

}  // namespace

#define PGJAX_CALL() ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<In>().Arg<In>()

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_neo_hookean, NeoHookean,
                              PGJAX_CALL().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_fixed_corotated, FixedCorotated,
                              PGJAX_CALL().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_stvk_hencky, StVKHencky,
                              PGJAX_CALL().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_von_mises, VonMises,
                              PGJAX_CALL().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_drucker_prager, DruckerPrager,
                              PGJAX_CALL().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
