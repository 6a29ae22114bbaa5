# Distance of trajectories from the surface over time.
file = dir . '/fig3c.csv'
set logscale y
set format y '10^{%L}'
set yrange [1e-17:100]
set grid lc rgb '#eeeeee'
set autoscale xfix
set xlabel 't [s]'
set ylabel 'distance from the surface [m]' noenhanced
set key outside right noenhanced width -8
names = 'analytic SE GP2 analytic_projected GP2_projected'
shown(x) = x < 1e-17 ? 1e-17 : x   # 0 has no logarithm
has_published = strstrt(system("head -1 '" . file . "'"), 'published') > 0
plot for [name in names] file using 't':(shown(column(name.'_surface_error'))) with lines lw 2 title name, \
     for [name in (has_published ? 'analytic SE GP2' : '')] file using 't':(column('published_'.name.'_surface_error')) with points pt 6 ps 0.4 title name.', published'
