// What each instruction-set variant offers to the dispatcher. Rows are projected with strict IEEE rules (rows.cpp);
// the pixel loops assume finite numbers (pixels.cpp): by then every NaN and infinity has been culled or refused.
#pragma once
#include "interface.h"

namespace splat {

struct RowKernels {
  void* (*create)();
  void (*destroy)(void*);
  void (*poison)(void*);
  const double* (*seconds)(void*);
  int64_t (*pair_count)(void*);
  int64_t (*sample_count)(void*);
  Status (*prepare)(void*, const View&, const Rows&, void* radii, Report&);
  void (*project_backward)(void*, const View&, const Rows&, const RowGradients&);
};

struct PixelKernels {
  void (*blend)(void*, const View&, bool gated, const Layers&);
  void (*finishers)(void*, const View&, const void* transmittance, const Finishers&);
  // `gates`: where the gradients of the gates of all `rows` go; null: there are none.
  void (*blend_backward)(void*, const View&, const void* transmittance, const Layers& cotangents, int64_t rows,
                         void* gates);
  void (*count)(void*, const View&, int64_t rows, const Counters&);
  // `drawn`: what blending has given, whose lists are still there; null: the lists are new, and blended here.
  void (*remove)(void*, const View&, int64_t rows, const Backdrop&, int64_t ways, const Layers* drawn, const Changes&);
};

struct SkyKernels {
  void (*over)(const Sky&, const void* rgb, const void* alpha, void* out);
  void (*backward)(const Sky&, const void* alpha, const void* v_out, void* v_alpha, void* v_texels);
};

struct LossKernels {
  void (*mean)(const PixelTerm&, const void* predicted, const void* truth, void* slopes, void* mean, void* share);
  void (*colors)(const Colors&, void* seen, void* truth, void* error);
  void (*colors_backward)(const Colors&, const void* truth, const void* v_value, void* v_image);
};

struct NodeKernels {
  void (*activate)(const RawRows&, const ActiveRows&);
  void (*activate_backward)(const RawRows&, const ActiveRows& cotangents, const RawGradients&);
  void (*poses)(const Keyframes&, const InstancePoses&);
  void (*poses_backward)(int64_t instances, const InstancePoses&, const void* quaternions, const void* translations,
                         void* rotation_deltas, void* translation_deltas);
};

struct AdamKernels {
  void (*step)(const AdamRows* tables, int64_t count, int64_t threads);
};

struct StatisticsKernels {
  void (*add)(const ScreenView&, const RowStatistics&);
};

struct SimilarityKernels {
  void (*forward)(const ImagePair&, void* partials, void* mean);
  void (*backward)(const ImagePair&, void* partials, const void* v_mean, void* v_image);
};

struct Kernels {
  const char* name;
  RowKernels rows[2];      // float, double
  PixelKernels pixels[2];
  SkyKernels sky[2];
  LossKernels losses[2];
  NodeKernels nodes[2];
  AdamKernels adam[2];
  StatisticsKernels statistics[2];
  SimilarityKernels similarity[2];
};

}  // namespace splat
