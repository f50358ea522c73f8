// What XLA calls: one library per precision (PGJAX_DOUBLE) and dimension (PGJAX_D).
//
// Arrays may have a leading batch direction; nodes hold four values.
// Without a total deformation H has no elements.
#include "exchange_call.h"

namespace {

ffi::Error Send(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t law, bool whole,
                Mask alive, Mask inside, In xi, In position, In mass, In volume, In v, In C, In He, In H, In mu,
                In lam, In numbers, Out g, MaskOut still_alive, MaskOut finite,
                ffi::Result<ffi::Buffer<ffi::S32>> events) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, *g);
  const auto in = sender(alive, inside, xi, position, mass, volume, v, C, He, H, mu, lam, numbers);
  const Sent<T> out{each(g, D + 1), each(still_alive, 1), each(finite, 1), each(events, 1)};
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto run = [&](auto kind) {
      send<T, D, K, Mls, decltype(kind)>(shape, batch_size(*g, D + 1), whole, in, out, pool);
    };
    if (law == 0) run(NeoHookean<T>());
    if (law == 1) run(FixedCorotated<T>());
    if (law == 2) run(StVKHencky<T>());
  });
}

ffi::Error Velocities(ffi::ThreadPool threads, std::int64_t contact, Sides x, Sides y, Sides z,
                      Bounds box, In momentum_and_mass, In numbers, In friction, Out v_and_mass) {
  Pool pool = pool_of(threads);
  velocities<T, D>(nodes_of(*v_and_mass).data(), batch_size(*v_and_mass, D + 1),
                   walls_of(contact, x, y, z, box), shared_or_each(momentum_and_mass, D + 1),
                   shared_or_each(numbers, 1), shared_or_each(friction, 1), each(v_and_mass, D + 1),
                   pool);
  return ffi::Error::Success();
}

ffi::Error VelocitiesTangent(ffi::ThreadPool threads, std::int64_t contact, Sides x, Sides y, Sides z,
                             Bounds box, In momentum_and_mass, In numbers, In friction, In dmomentum_and_mass,
                             In dnumbers, In dfriction, Out dv_and_mass) {
  Pool pool = pool_of(threads);
  velocities_tangent<T, D>(nodes_of(*dv_and_mass).data(), batch_size(*dv_and_mass, D + 1),
                           walls_of(contact, x, y, z, box), shared_or_each(momentum_and_mass, D + 1),
                           shared_or_each(numbers, 1), shared_or_each(friction, 1),
                           shared_or_each(dmomentum_and_mass, D + 1), shared_or_each(dnumbers, 1),
                           shared_or_each(dfriction, 1), each(dv_and_mass, D + 1), pool);
  return ffi::Error::Success();
}

ffi::Error Receive(ffi::ThreadPool threads, std::int64_t degree, bool mls, std::int64_t map,
                   Mask alive, Mask finite, Mask held, In xi, In g, In position, In v, In C, In He,
                   In H, In first, In second, In third, In numbers, Out new_position, Out new_v,
                   Out new_C, Out new_He, Out new_H, Out history) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  const auto in = receiver(alive, finite, held, xi, g, position, v, C, He, H, first, second, third,
                           numbers);
  const Received<T> out{each(new_position, 2), each(new_v, 2), each(new_C, 3),
                        each(new_He, 3),       each(new_H, 3), each(history, 1)};
  return with_kind(degree, mls, [&](auto K, auto Mls) {
    const auto run = [&](auto kind) {
      receive<T, D, K, Mls, decltype(kind)>(shape, batch_size(*new_v, 2), in, out, pool);
    };
    if (map == 0) run(Elastic<T>());
    if (map == 1) run(VonMises<T>());
    if (map == 2) run(DruckerPrager<T>());
  });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_send, Send,
                              PGJAX_CALL().Attr<bool>("whole").Arg<Mask>().Arg<Mask>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().PGJAX_RET.Ret<Mask>().Ret<Mask>()
                                  .Ret<ffi::Buffer<ffi::S32>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_velocities, Velocities,
                              PGJAX_WALLS().Arg<In>().Arg<In>().Arg<In>().PGJAX_RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_velocities_tangent, VelocitiesTangent,
                              PGJAX_WALLS().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().PGJAX_RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_receive, Receive,
                              PGJAX_CALL().Arg<Mask>().Arg<Mask>().Arg<Mask>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>()
                                  .PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET.PGJAX_RET);
