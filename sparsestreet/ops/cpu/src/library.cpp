// The exported C functions: pick the instruction set once, guard against exceptions, call the variant's kernels.
#include <new>

#include "kernels.h"

#define SPLAT_DECLARE(variant)                   \
  namespace variant {                            \
  void fill_row_kernels(splat::Kernels&);        \
  void fill_pixel_kernels(splat::Kernels&);      \
  void fill_sky_kernels(splat::Kernels&);        \
  void fill_node_kernels(splat::Kernels&);       \
  void fill_similarity_kernels(splat::Kernels&); \
  }
SPLAT_DECLARE(baseline)
#ifdef SPLAT_X86
SPLAT_DECLARE(v3)
SPLAT_DECLARE(v4)
#endif

namespace {

using namespace splat;

template <class... Fill>
Kernels make(const char* name, Fill... fill) {
  Kernels k{};
  k.name = name;
  (fill(k), ...);
  return k;
}

bool runs(int variant) {
#ifdef SPLAT_X86
  __builtin_cpu_init();
  bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
            __builtin_cpu_supports("bmi2");
#ifndef __clang__  // Before version 19 it knows neither name, and no processor with AVX2 and BMI2 lacks them.
  v3 = v3 && __builtin_cpu_supports("f16c") && __builtin_cpu_supports("lzcnt");
#endif
  const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                  __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                  __builtin_cpu_supports("avx512vl");
  return variant == 0 || (variant == 1 && v3) || (variant == 2 && v4);
#else
  return variant == 0;
#endif
}

// A variant's table is filled by code of that variant, which may already use its instructions (gcc fills it by vectors of
// 512 bits): only what runs here is ever called.
const Kernels* variant(int index) {
#ifdef SPLAT_X86
  if (index == 2) {
    static const Kernels kernels = make("x86-64-v4", v4::fill_row_kernels, v4::fill_pixel_kernels, v4::fill_sky_kernels,
                                        v4::fill_node_kernels, v4::fill_similarity_kernels);
    return &kernels;
  }
  if (index == 1) {
    static const Kernels kernels = make("x86-64-v3", v3::fill_row_kernels, v3::fill_pixel_kernels, v3::fill_sky_kernels,
                                        v3::fill_node_kernels, v3::fill_similarity_kernels);
    return &kernels;
  }
#endif
  static const Kernels kernels =
      make("baseline", baseline::fill_row_kernels, baseline::fill_pixel_kernels, baseline::fill_sky_kernels,
           baseline::fill_node_kernels, baseline::fill_similarity_kernels);
  return &kernels;
}

int fastest() {
  int best = 0;
  for (int index = 1; index < 3; ++index)
    if (runs(index)) best = index;
  return best;
}

// As splat_variant_name takes them.
const Kernels& chosen(int index) { return *variant(index < 0 ? fastest() : index); }

struct Handle {
  const Kernels* kernels;
  int scalar;  // 0 float, 1 double
  void* workspace;
  const RowKernels& rows() const { return kernels->rows[scalar]; }
  const PixelKernels& pixels() const { return kernels->pixels[scalar]; }
};

template <class Call>
int32_t guarded(Call call) {
  try {
    return call();
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  }
}

}  // namespace

#define SPLAT_API extern "C" __attribute__((visibility("default")))

SPLAT_API int32_t splat_interface_version() { return INTERFACE_VERSION; }
SPLAT_API int32_t splat_tile_size() { return TILE; }

// Variants: 0 baseline, 1 x86-64-v3, 2 x86-64-v4; -1 the fastest that runs here. Null if it does not run here.
SPLAT_API const char* splat_variant_name(int32_t index) {
  if (index < 0) index = fastest();
  return index < 3 && runs(index) ? variant(index)->name : nullptr;
}

SPLAT_API void* splat_create(int32_t is_double, int32_t index) {
  if (index < 0) index = fastest();
  if (index >= 3 || !runs(index)) return nullptr;
  try {
    const Kernels* kernels = variant(index);
    return new Handle{kernels, is_double, kernels->rows[is_double].create()};
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

SPLAT_API void splat_destroy(Handle* h) {
  h->rows().destroy(h->workspace);
  delete h;
}

SPLAT_API void splat_poison(Handle* h) { h->rows().poison(h->workspace); }
SPLAT_API const double* splat_stage_seconds(Handle* h) { return h->rows().seconds(h->workspace); }
SPLAT_API int64_t splat_pair_count(Handle* h) { return h->rows().pair_count(h->workspace); }

SPLAT_API int64_t splat_sample_count(Handle* h) { return h->rows().sample_count(h->workspace); }

SPLAT_API int32_t splat_forward(Handle* h, const View* view, const Rows* rows, const Layers* image, void* radii,
                                Report* report) {
  return guarded([&]() -> int32_t {
    const Status status = h->rows().prepare(h->workspace, *view, *rows, radii, *report);
    if (status == OK) h->pixels().blend(h->workspace, *view, rows->gates, *image);
    return status;
  });
}

// Uses what splat_forward left in the workspace; null pointers in `cotangents` stand for zeros.
SPLAT_API int32_t splat_backward(Handle* h, const View* view, const Rows* rows, const void* transmittance,
                                 const Layers* cotangents, const RowGradients* gradients) {
  return guarded([&]() -> int32_t {
    h->pixels().blend_backward(h->workspace, *view, transmittance, *cotangents, rows->count, gradients->gates);
    h->rows().project_backward(h->workspace, *view, *rows, *gradients);
    return OK;
  });
}

// What finished the pixels of the view that splat_forward has left in the workspace.
SPLAT_API void splat_finishers(Handle* h, const View* view, const void* transmittance, const Finishers* out) {
  h->pixels().finishers(h->workspace, *view, transmittance, *out);
}

SPLAT_API int32_t splat_contribution(Handle* h, const View* view, const Rows* rows, const Counters* counters,
                                     Report* report) {
  return guarded([&]() -> int32_t {
    const Status status = h->rows().prepare(h->workspace, *view, *rows, nullptr, *report);
    if (status == OK) h->pixels().count(h->workspace, *view, rows->count, *counters);
    return status;
  });
}

SPLAT_API int32_t splat_leave_one_out(Handle* h, const View* view, const Rows* rows, const Backdrop* sky_image,
                                const Changes* changes, Report* report) {
  return guarded([&]() -> int32_t {
    const Status status = h->rows().prepare(h->workspace, *view, *rows, nullptr, *report);
    if (status == OK) h->pixels().remove(h->workspace, *view, rows->count, *sky_image, 1, nullptr, *changes);
    return status;
  });
}

// The same of the view that splat_forward has left in the workspace and in `image`, counted in COUNTINGS ways.
SPLAT_API int32_t splat_gather(Handle* h, const View* view, int64_t rows, const Layers* image, const Backdrop* sky_image,
                               const Changes* changes) {
  return guarded([&]() -> int32_t {
    return h->pixels().remove(h->workspace, *view, rows, *sky_image, COUNTINGS, image, *changes), OK;
  });
}

// Sky behind an image. Variants as in splat_variant_name, here and below.
SPLAT_API void splat_over_sky(int32_t is_double, int32_t index, const Sky* sky, const void* rgb, const void* alpha,
                              void* out) {
  chosen(index).sky[is_double].over(*sky, rgb, alpha, out);
}

SPLAT_API void splat_over_sky_backward(int32_t is_double, int32_t index, const Sky* sky, const void* alpha,
                                       const void* v_out, void* v_alpha, void* v_texels) {
  chosen(index).sky[is_double].backward(*sky, alpha, v_out, v_alpha, v_texels);
}

// Fills the rows as they are splatted.
SPLAT_API int32_t splat_activate(int32_t is_double, int32_t index, const RawRows* rows, const ActiveRows* out) {
  return guarded([&]() -> int32_t { return chosen(index).nodes[is_double].activate(*rows, *out), OK; });
}

SPLAT_API int32_t splat_activate_backward(int32_t is_double, int32_t index, const RawRows* rows,
                                          const ActiveRows* cotangents, const RawGradients* gradients) {
  return guarded([&]() -> int32_t {
    return chosen(index).nodes[is_double].activate_backward(*rows, *cotangents, *gradients), OK;
  });
}

SPLAT_API void splat_poses(int32_t is_double, int32_t index, const Keyframes* keyframes, const InstancePoses* out) {
  chosen(index).nodes[is_double].poses(*keyframes, *out);
}

SPLAT_API void splat_poses_backward(int32_t is_double, int32_t index, int64_t instances, const InstancePoses* of,
                                    const void* quaternions, const void* translations, void* rotation_deltas,
                                    void* translation_deltas) {
  chosen(index).nodes[is_double].poses_backward(instances, *of, quaternions, translations, rotation_deltas,
                                                translation_deltas);
}

SPLAT_API void splat_adam(int32_t is_double, int32_t index, const AdamRows* tables, int64_t count, int64_t threads) {
  chosen(index).adam[is_double].step(tables, count, threads);
}

SPLAT_API void splat_statistics(int32_t is_double, int32_t index, const ScreenView* view, const RowStatistics* into) {
  chosen(index).statistics[is_double].add(*view, *into);
}

// A weighted mean over pixels, the share of each in it, and unless `slopes` is null the derivative of each.
SPLAT_API int32_t splat_pixel_mean(int32_t is_double, int32_t index, const PixelTerm* term, const void* predicted,
                                   const void* truth, void* slopes, void* mean, void* share) {
  return guarded([&]() -> int32_t {
    return chosen(index).losses[is_double].mean(*term, predicted, truth, slopes, mean, share), OK;
  });
}

// What is compared of both images, and the sum of errors times `scale`.
SPLAT_API int32_t splat_colors(int32_t is_double, int32_t index, const Colors* colors, void* seen, void* truth,
                               void* error) {
  return guarded([&]() -> int32_t { return chosen(index).losses[is_double].colors(*colors, seen, truth, error), OK; });
}

// Adds the gradient of the errors to `v_image`, and takes both from what does not count.
SPLAT_API void splat_colors_backward(int32_t is_double, int32_t index, const Colors* colors, const void* truth,
                                     const void* v_value, void* v_image) {
  chosen(index).losses[is_double].colors_backward(*colors, truth, v_value, v_image);
}

// Mean similarity, and its partial derivatives unless `partials` is null.
SPLAT_API int32_t splat_ssim(int32_t is_double, int32_t index, const ImagePair* pair, void* partials, void* mean) {
  return guarded([&]() -> int32_t { return chosen(index).similarity[is_double].forward(*pair, partials, mean), OK; });
}

// Gradient of the image, from the partial derivatives that splat_ssim left.
SPLAT_API void splat_ssim_backward(int32_t is_double, int32_t index, const ImagePair* pair, void* partials,
                                   const void* v_mean, void* v_image) {
  chosen(index).similarity[is_double].backward(*pair, partials, v_mean, v_image);
}
