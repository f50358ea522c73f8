// What XLA calls for the derivatives of `exchange.cc` in reverse mode; arrays are those of that file.
#include "exchange_pull.h"

#include "exchange_call.h"

namespace {

ffi::Error SendPull(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t law,
                    Mask alive, Mask inside, In xi, In position, In mass, In volume, In v, In C,
                    In He, In H, In mu, In lam, In numbers, In g_bar, Out xi_bar, Out position_bar,
                    Out mass_bar, Out volume_bar, Out v_bar, Out C_bar, Out He_bar, Out H_bar,
                    Out mu_bar, Out lam_bar, Out numbers_bar) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g_bar);
  const auto in = sender(alive, inside, xi, position, mass, volume, v, C, He, H, mu, lam, numbers);
  const SenderBars<T> out{each(xi_bar, 2),
                          each(position_bar, 2),
                          each(mass_bar, 1),
                          each(volume_bar, 1),
                          each(v_bar, 2),
                          each(C_bar, 3),
                          each(He_bar, 3),
                          each(H_bar, 3),
                          {each(mu_bar, 1), each(lam_bar, 1)},
                          each(numbers_bar, 1),
                          {each_particle(mu), each_particle(lam)}};
  const Index batch = batch_size(*xi_bar, 2);
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto g = shared_or_each(g_bar, D + 1);
    if (law == 0) send_pull<T, D, K, Mls, NeoHookean>(shape, batch, in, g, out, pool);
    if (law == 1) send_pull<T, D, K, Mls, FixedCorotated>(shape, batch, in, g, out, pool);
    if (law == 2) send_pull<T, D, K, Mls, StVKHencky>(shape, batch, in, g, out, pool);
  });
}

ffi::Error VelocitiesPull(ffi::ThreadPool threads, std::int64_t contact, Sides x, Sides y, Sides z,
                          Bounds box, In momentum_and_mass, In numbers, In friction, In bar,
                          Out momentum_and_mass_bar, Out numbers_bar, Out friction_bar) {
  Pool pool = pool_of(threads);
  velocities_pull<T, D>(nodes_of(momentum_and_mass).data(), batch_size(*momentum_and_mass_bar, D + 1),
                        walls_of(contact, x, y, z, box), shared_or_each(momentum_and_mass, D + 1),
                        shared_or_each(numbers, 1), shared_or_each(friction, 1),
                        shared_or_each(bar, D + 1), each(momentum_and_mass_bar, D + 1),
                        each(numbers_bar, 1), each(friction_bar, 1), pool);
  return ffi::Error::Success();
}

ffi::Error ReceivePull(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t map,
                       bool correct, Mask alive, Mask finite, Mask held, In xi, In g, In position,
                       In v, In C, In He, In H, In first, In second, In third, In numbers,
                       In position_bar, In v_bar, In C_bar, In He_bar, In H_bar, In history_bar,
                       Out to_xi, Out to_g, Out to_position, Out to_v, Out to_C, Out to_He, Out to_H,
                       Out to_first, Out to_second, Out to_third, Out to_numbers) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  const auto in = receiver(alive, finite, held, xi, g, position, v, C, He, H, first, second, third,
                           numbers);
  const ReceivedBars<T> bar{shared_or_each(position_bar, 2), shared_or_each(v_bar, 2),
                            shared_or_each(C_bar, 3),        shared_or_each(He_bar, 3),
                            shared_or_each(H_bar, 3),        shared_or_each(history_bar, 1)};
  const ReceiverBars<T> out{
      each(to_xi, 2),
      each(to_g, D + 1),
      each(to_position, 2),
      each(to_v, 2),
      each(to_C, 3),
      each(to_He, 3),
      each(to_H, 3),
      {each(to_first, 1), each(to_second, 1), each(to_third, 1)},
      each(to_numbers, 1),
      {each_particle(first), each_particle(second), each_particle(third)}};
  const Index batch = batch_size(*to_xi, 2);
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto run = [&](auto kind) {
      receive_pull<T, D, K, Mls, decltype(kind)>(shape, batch, in, correct, bar, out, pool);
    };
    if (map == 0) run(Elastic<T>());
    if (map == 1) run(VonMises<T>());
    if (map == 2) run(DruckerPrager<T>());
  });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_send_pull, SendPull,
                              PGJAX_CALL().Arg<Mask>().Arg<Mask>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>()
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_velocities_pull, VelocitiesPull,
                              PGJAX_WALLS().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_receive_pull, ReceivePull,
                              PGJAX_CALL().Attr<bool>("correct").Arg<Mask>().Arg<Mask>().Arg<Mask>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET);
