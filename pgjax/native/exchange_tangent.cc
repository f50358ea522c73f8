// What XLA calls for the derivatives of `exchange.cc` in forward mode; arrays are those of that file.
#include "exchange_tangent.h"

#include "exchange_call.h"

namespace {

ffi::Error SendTangent(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t law,
                       Mask alive, Mask inside, In xi, In position, In mass, In volume, In v, In C,
                       In He, In H, In mu, In lam, In numbers, In dxi, In dposition, In dmass,
                       In dvolume, In dv, In dC, In dHe, In dH, In dmu, In dlam, In dnumbers,
                       Out dg) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, *dg);
  const auto in = sender(alive, inside, xi, position, mass, volume, v, C, He, H, mu, lam, numbers);
  const auto along = sender(alive, inside, dxi, dposition, dmass, dvolume, dv, dC, dHe, dH, dmu, dlam,
                            dnumbers);
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto run = [&](auto kind) {
      send_tangent<T, D, K, Mls, decltype(kind)>(shape, batch_size(*dg, D + 1), in, along,
                                                 each(dg, D + 1), pool);
    };
    if (law == 0) run(NeoHookean<T>());
    if (law == 1) run(FixedCorotated<T>());
    if (law == 2) run(StVKHencky<T>());
  });
}

ffi::Error ReceiveTangent(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t map,
                          bool correct, Mask alive, Mask finite, Mask held, In xi, In g, In position,
                          In v, In C, In He, In H, In first, In second, In third, In numbers, In dxi,
                          In dg, In dposition, In dv, In dC, In dHe, In dH, In dfirst, In dsecond,
                          In dthird, In dnumbers, Out to_position, Out to_v, Out to_C, Out to_He,
                          Out to_H, Out to_history) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  const auto in = receiver(alive, finite, held, xi, g, position, v, C, He, H, first, second, third,
                           numbers);
  const auto along = receiver(alive, finite, held, dxi, dg, dposition, dv, dC, dHe, dH, dfirst, dsecond,
                              dthird, dnumbers);
  const Received<T> out{each(to_position, 2), each(to_v, 2), each(to_C, 3),
                        each(to_He, 3),       each(to_H, 3), each(to_history, 1)};
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto run = [&](auto kind) {
      receive_tangent<T, D, K, Mls, decltype(kind)>(shape, batch_size(*to_v, 2), in, along, correct, out,
                                                    pool);
    };
    if (map == 0) run(Elastic<T>());
    if (map == 1) run(VonMises<T>());
    if (map == 2) run(DruckerPrager<T>());
  });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_send_tangent, SendTangent,
                              PGJAX_CALL().Arg<Mask>().Arg<Mask>().PGJAX_FLOATS.PGJAX_FLOATS.PGJAX_RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_receive_tangent, ReceiveTangent,
                              PGJAX_CALL().Attr<bool>("correct").Arg<Mask>().Arg<Mask>().Arg<Mask>()
                                  .PGJAX_FLOATS.PGJAX_FLOATS.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET
                                  .PGJAX_RET.PGJAX_RET);
